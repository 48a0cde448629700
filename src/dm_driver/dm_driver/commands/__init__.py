"""Which commands are accepted, who holds the mirror, and the action `degauss`."""
