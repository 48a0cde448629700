"""Damaged files for every reader: intact files, seeded mutations, and what a reader makes of each."""
