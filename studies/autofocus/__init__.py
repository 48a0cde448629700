"""How many images a search of the sharpest focus takes: ours beside others, on scenes drawn at random."""
