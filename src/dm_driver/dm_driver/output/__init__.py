"""output of dm_driver."""
