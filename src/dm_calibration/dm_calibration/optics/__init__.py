"""Optics of a mirror surface on a circular aperture: polynomials, sampling, fits. Knows no ROS."""
