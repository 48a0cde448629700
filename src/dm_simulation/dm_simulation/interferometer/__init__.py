"""The interferometer: maps of the plate, map files and trigger."""
