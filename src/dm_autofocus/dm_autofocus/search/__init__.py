"""Search of the sharpest focus: state machines that are fed images or their sharpness, without cameras or ROS."""
