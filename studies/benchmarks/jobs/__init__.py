"""Benchmarks of computation: each times one task beside the usual alternative."""
