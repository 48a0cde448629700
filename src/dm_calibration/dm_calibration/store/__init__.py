"""Calibration files: HDF5 read in a process of its own, written whole or not at all."""
