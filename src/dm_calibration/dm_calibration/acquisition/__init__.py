"""Maps from the instrument: a watched folder, a trigger, files read once they are complete."""
