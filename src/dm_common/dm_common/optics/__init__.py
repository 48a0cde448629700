"""Zernike terms, conic surfaces, sampling points, piston and tilt."""
