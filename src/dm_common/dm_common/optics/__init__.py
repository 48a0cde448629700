"""optics of dm_common."""
