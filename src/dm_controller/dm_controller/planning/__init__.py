"""From a target and the state of the actuators to a command: targets, the mirror, plans and recipes."""
