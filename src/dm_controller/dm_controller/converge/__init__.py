"""The closed loop on the interferometer, and recipes built by it."""
