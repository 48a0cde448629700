"""The faults of `dm faults`, by the part that they hit, and their registry."""
