"""The mirror: piezo stacks under an elastic plate."""
