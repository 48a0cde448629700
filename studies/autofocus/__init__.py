"""Number of images that a search for the sharpest focus takes: ours beside others, on scenes drawn at random."""
