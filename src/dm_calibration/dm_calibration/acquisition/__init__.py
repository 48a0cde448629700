"""Maps from the instrument: watched folder, trigger command, and reading of files once they are complete."""
