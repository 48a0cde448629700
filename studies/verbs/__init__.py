"""Verbs of `dm` that exist in a checkout but not in an installation: bench, compare, paper, test."""
