"""Focus for a camera behind the mirror: thin optics, sharpness of images, search of the sharpest focus, node, client.

`from dm_autofocus import CameraFocusClient` is what a program needs that uses the camera.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dm_autofocus.camera_client import CameraFocusClient

__all__ = ["CameraFocusClient"]


def __getattr__(name: str) -> Any:
    """The client on its first use: the node does without it."""
    if name in __all__:
        from dm_autofocus import camera_client

        return getattr(camera_client, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
