"""hysteresis of dm_common."""
