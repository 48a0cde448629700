"""Measurements of speed and memory, each beside the usual alternative, in one run on one machine."""
