"""The model of hysteresis and creep, its state along the commands, and its inverse."""
