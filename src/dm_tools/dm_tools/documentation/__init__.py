"""documentation of dm_tools."""
