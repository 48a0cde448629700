"""recalibration of dm_calibration."""
