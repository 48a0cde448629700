"""What `dm doctor` checks, on the machine and in a configuration."""
