"""electronics of dm_simulation."""
