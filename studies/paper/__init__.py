"""The paper's tables and figures, made on the virtual bench and set beside the paper's own values."""
