"""Who may command the mirror, and the requests that take a while."""
