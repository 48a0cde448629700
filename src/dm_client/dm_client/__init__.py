"""Python client of the suite for vision stacks: no callbacks, no executors."""
