"""mirror of dm_simulation."""
