"""Python client of the suite for vision stacks: no callbacks, no executors."""

from dm_client.client import STARTING_S, Claim, DeformableMirrorClient
from dm_client.connection import DeformableMirrorError

__all__ = ["STARTING_S", "Claim", "DeformableMirrorClient", "DeformableMirrorError"]
