"""acquisition of dm_calibration."""
