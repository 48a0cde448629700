"""From shapes to the codes of a drive unit, and back to the signals at the actuators."""
