"""The pages of interfaces and parameters, written from the code."""
