"""store of dm_calibration."""
