"""Python client of the suite for vision stacks: no callbacks, no executors."""

from dm_client.client import STARTING_S, DeformableMirrorClient, DeformableMirrorError

__all__ = ["STARTING_S", "DeformableMirrorClient", "DeformableMirrorError"]
