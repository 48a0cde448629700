"""Where the focus is sharpest: state machines that are fed images or their sharpness; no cameras, no ROS."""
