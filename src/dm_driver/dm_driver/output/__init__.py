"""From shapes to the codes of a drive unit, and back to what stands at the actuators."""
