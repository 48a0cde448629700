"""Experiments on the virtual bench, in process and without ROS: the methods side by side, the tables of [1]."""
