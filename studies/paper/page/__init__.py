"""The page that sets the paper's tables and figures beside those of the virtual bench."""
