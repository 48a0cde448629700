"""Launch files, configurations and the registry of the suite's nodes."""
