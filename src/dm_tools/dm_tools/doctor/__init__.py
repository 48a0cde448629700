"""doctor of dm_tools."""
