"""Solvers that serve only for comparison with those of the controller."""
