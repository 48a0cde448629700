"""Regression of the surface control error on what is known of a surface ([1], section 3.1)."""
