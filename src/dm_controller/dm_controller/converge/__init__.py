"""converge of dm_controller."""
