"""What `dm doctor` looks for, on the machine and in a configuration."""
