"""procedure of dm_calibration."""
