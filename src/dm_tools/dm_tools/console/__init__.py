"""The bench console: a web page on loopback that talks to the nodes through ROS interfaces only."""

#: Only this machine.
HOST = "127.0.0.1"
