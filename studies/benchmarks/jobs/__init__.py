"""Benchmarks of computation: each times one task beside what a user would take instead."""
