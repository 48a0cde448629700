"""Measurements of speed and memory, each beside what a user would take instead, in one run on one machine."""
