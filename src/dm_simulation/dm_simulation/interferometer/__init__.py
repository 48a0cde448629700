"""The interferometer: pictures of the plate, its files and its trigger."""
