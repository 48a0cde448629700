"""Studies that are not installed: the paper's page, the comparison of methods, benchmarks, and their verbs of `dm`."""
