"""Images of a camera: their grey levels as arrays, and which of them show the focus that was asked for."""

from __future__ import annotations

import math
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


class SettledGate:
    """Ties images to a move through their time stamps: those count that were exposed after it had ended and settled.

    All times in s of one clock.

    Args:
        settle_time: wait after the last write to the electronics [s].
        stamp_lead: by how much the exposure began before the image's stamp [s]; 0 = stamps mark its beginning.

    Attributes:
        settled_at: when the shape of the last move stands; inf = not known yet.
    """

    def __init__(self, settle_time: float, stamp_lead: float = 0.0) -> None:
        self._settle_time = settle_time
        self._stamp_lead = stamp_lead
        self._sent_at = math.inf
        self._stands_at = math.inf
        self.settled_at = math.inf

    def sent(self, stamp: float, duration: float = 0.0) -> None:
        """A command left at `stamp`; its shape is predicted to stand `duration` later."""
        self._sent_at = stamp
        self._stands_at = stamp + duration
        self.settled_at = math.inf

    def written(self, stamp: float, moving: bool, reached: bool) -> None:
        """The driver reports its last write at `stamp`; `reached`: what stands is already what the command asked for.

        A report older than the command counts only when nothing had to move.
        """
        if math.isinf(self.settled_at) and not moving and (stamp >= self._sent_at or reached):
            self.settled_at = max(stamp, self._stands_at) + self._settle_time

    def open_for(self, stamp: float) -> bool:
        """Whether an image with this stamp was exposed after the shape stood."""
        return stamp - self._stamp_lead >= self.settled_at
