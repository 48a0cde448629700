"""Focus for a camera behind the mirror: thin optics, sharpness of images, search of the sharpest focus, node, client.

`from dm_autofocus import CameraFocusClient` is what a program needs that uses the camera.
"""

from dm_autofocus.camera_client import CameraFocusClient

__all__ = ["CameraFocusClient"]
