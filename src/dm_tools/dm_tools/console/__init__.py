"""The bench console: a web page on loopback that talks to the nodes through ROS interfaces only."""
