"""Verbs of `dm` that a checkout has and an installation has not: bench, compare, paper, test."""
