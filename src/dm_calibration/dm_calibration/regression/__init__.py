"""Regression of the surface control error on known properties of a surface ([1], section 3.1)."""
