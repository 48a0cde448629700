"""Staying on an object that moves: place and speed of the focus from how blurred the latest images are.

The images of the last moments, taken half a dither below and above where the focus is believed to be, say through the
optics (`DefocusModel`) where it is, if it moved at a speed: each speed of a few is tried, with the images shifted by
what the object has moved since. What is believed already weighs as a normal distribution of both.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import TRANSFER_ERROR_NEAR, DefocusModel, Floats
from dm_autofocus.search.peak_search import Peak, SearchConfig, Step
from dm_autofocus.search.tracking import TrackConfig, Tracker

#: Images that count at a time, and from how many on they say something.
IMAGES, FEWEST = 5, 3
#: How far from the believed place the focus is sought, and steps of that grid, in depths of focus.
REACH, GRID = 12.0, 0.25
#: Changes of speed that are tried at each image, in depths of focus per second.
SPEEDS = 5.0 * np.arange(-3, 4)
#: Standard deviations of what is believed of place [depths of focus] and speed [depths of focus per second].
PLACE_SIGMA, SPEED_SIGMA = 3.0, 8.0
#: Share by which the period follows each image, and longest one that counts [s].
PERIOD_SHARE, PERIOD_MAX = 0.3, 0.3


class MotionTracker(Tracker):
    """A tracker for a camera and a mirror that are known.

    Args:
        peak: what was found.
        search: range and tolerance of the search.
        config: how to stay on it; its dither is above 0.
        model: of the camera.

    Attributes:
        speed: of the focus [1/m per s].
    """

    def __init__(self, peak: Peak, search: SearchConfig, config: TrackConfig, model: DefocusModel) -> None:
        super().__init__(peak.curvature, peak.sharpness, search.low, search.high, config)
        self.speed = 0.0
        self._tolerance, self._model = search.tolerance, model
        self._images: deque[tuple[float, float, Floats]] = deque(maxlen=IMAGES)  # time, place, powers
        self._period = 0.0
        self._sign = 1
        self._aim()

    def feed(self, sharpness: float, images: Sequence[NDArray] = (), time: float = math.nan) -> None:
        self._watch(sharpness, time)
        if self.hidden:
            self.speed = 0.0
            self._images.clear()
            self.step = Step(self.centre)
            return
        if any(image.shape != self._model.shape for image in images):
            self.lost = True
            return
        if self._images:
            passed = min(max(time - self._images[-1][0], 0.0), PERIOD_MAX)
            self.centre += self.speed * passed
            self._period += PERIOD_SHARE * (passed - self._period) if self._period else passed
        powers = np.mean([self._model.powers(image) for image in images], axis=0)
        self._images.append((time, self.step.curvature, powers))
        if len(self._images) >= FEWEST:
            self._estimate()
        inside = min(max(self.centre, self.low), self.high)
        if inside != self.centre:
            self.centre, self.speed = inside, 0.0
        self._aim()

    def _estimate(self) -> None:
        """Place and speed by the latest images."""
        times, places, powers = (np.array(part) for part in zip(*self._images, strict=True))
        tolerance, ago = self._tolerance, times[-1] - times
        offsets = tolerance * np.arange(-REACH, REACH + GRID / 2, GRID)
        misfit = np.array(
            [
                self._model.judge(
                    self.centre + offsets, places + (self.speed + more * tolerance) * ago, powers, TRANSFER_ERROR_NEAR
                )[0]
                for more in SPEEDS
            ]
        )
        misfit += (offsets / (PLACE_SIGMA * tolerance)) ** 2 + (SPEEDS[:, None] / SPEED_SIGMA) ** 2
        weights = np.exp((misfit.min() - misfit) / 2)
        weights /= weights.sum()
        self.centre += float(weights.sum(0) @ offsets)
        self.speed += tolerance * float(weights.sum(1) @ SPEEDS)

    def _aim(self) -> None:
        """The next image: where the focus will be then, below and above by turns."""
        self._sign = -self._sign
        place = self.centre + self.speed * self._period + self._sign * self.config.dither
        self.step = Step(min(max(place, self.low), self.high))
