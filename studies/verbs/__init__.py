"""Verbs of `dm` that run a study: bench, compare, paper."""
