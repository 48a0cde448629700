"""The tables and figures of [1], here "the paper", made on the virtual bench and set beside the paper's own values."""
