"""Solvers that exist to be compared with those of the controller."""
