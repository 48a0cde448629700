"""Interferometer map ingest and calibration of deformable mirrors."""
