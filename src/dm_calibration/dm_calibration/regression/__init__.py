"""Regression of the surface control error on what is known of a surface (the paper's section 3.1)."""
