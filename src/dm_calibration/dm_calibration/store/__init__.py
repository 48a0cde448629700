"""Calibration files: HDF5, read in a separate process, written atomically."""
