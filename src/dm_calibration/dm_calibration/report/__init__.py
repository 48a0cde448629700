"""The report of a calibration: one HTML and one PDF file that a lab keeps. Knows no ROS."""
