"""Recordings of a bench session in MCAP, as rosbag2 writes them, and what can be made of them."""
