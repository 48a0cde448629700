"""Grey levels of a camera image as an array, without a copy where there need not be one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: encoding -> (number type, channels, channel taken). Of colours the green one: it has most of the luminance, and in a
#: Bayer sensor half of the pixels.
ENCODINGS: dict[str, tuple[str, int, int]] = {
    "mono8": ("u1", 1, 0),
    "8UC1": ("u1", 1, 0),
    "mono16": ("u2", 1, 0),
    "16UC1": ("u2", 1, 0),
    "32FC1": ("f4", 1, 0),
    "rgb8": ("u1", 3, 1),
    "bgr8": ("u1", 3, 1),
    "8UC3": ("u1", 3, 1),
    "rgba8": ("u1", 4, 1),
    "bgra8": ("u1", 4, 1),
}


class ImageError(ValueError):
    """An image that cannot be used; the message says why."""


def grey(message: Any) -> NDArray:
    """Grey levels (height, width) of a `sensor_msgs/Image`: its own numbers, colours by their green channel.

    Args:
        message: anything with height, width, encoding, is_bigendian, step (bytes per row) and data.

    Raises:
        ImageError: unknown encoding, or sizes that contradict each other.
    """
    if message.encoding not in ENCODINGS:
        raise ImageError(f"encoding = {message.encoding!r}: must be one of {', '.join(ENCODINGS)}")
    code, channels, channel = ENCODINGS[message.encoding]
    kind = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    width, height = int(message.width), int(message.height)
    step = int(message.step) or width * channels * kind.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if step < width * channels * kind.itemsize or len(data) < step * height or width * height == 0:
        raise ImageError(
            f"an image of {width} x {height} px {message.encoding} with {step} bytes per row cannot have "
            f"{len(data)} bytes of data"
        )
    shape, strides = (height, width), (step, channels * kind.itemsize)
    pixels: NDArray = np.ndarray(shape, kind, data, channel * kind.itemsize, strides)
    return pixels if kind.isnative else pixels.astype(kind.newbyteorder("="))
