"""verbs of dm_tools."""
