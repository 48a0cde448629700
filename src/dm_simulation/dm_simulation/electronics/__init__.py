"""The drive electronics behind the wire."""
