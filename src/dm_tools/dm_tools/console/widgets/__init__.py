"""The cards of the console's page."""
