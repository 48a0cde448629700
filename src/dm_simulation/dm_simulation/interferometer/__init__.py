"""interferometer of dm_simulation."""
