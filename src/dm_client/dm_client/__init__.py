"""Python client of the suite for vision stacks: no callbacks, no executors."""

from dm_client.client import STARTING_S, DeformableMirrorClient
from dm_client.connection import DeformableMirrorError
from dm_client.fields import Claim, FocusOptions

__all__ = ["STARTING_S", "Claim", "DeformableMirrorClient", "DeformableMirrorError", "FocusOptions"]
