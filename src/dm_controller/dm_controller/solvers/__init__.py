"""Solvers: from a wanted surface to actuator signals."""
