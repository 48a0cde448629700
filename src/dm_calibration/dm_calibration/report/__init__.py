"""The report of a calibration: one HTML and one PDF file for the records of a lab. Independent of ROS."""
