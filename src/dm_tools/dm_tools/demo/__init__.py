"""demo of dm_tools."""
