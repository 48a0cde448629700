"""Real nodes in front of emulated electronics, networks and clients, for faults to be injected into."""
