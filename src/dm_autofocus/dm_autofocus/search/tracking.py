"""Staying on the sharpest focus: state machines like `PeakSearch`, for a scene that changes.

A `Tracker` uses sharpness alone. A `MotionTracker` knows camera and mirror: from the latest images, taken half a dither
below and above the expected focus, the optics (`DefocusModel`) give its place for an assumed speed. Several speeds are
tried, with the images shifted by what the object has moved since. The previous estimate enters as a normal distribution
of place and speed.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import TRANSFER_ERROR_NEAR, DefocusModel
from dm_autofocus.search.peak_search import Peak, SearchConfig, Step
from dm_common import Floats
from dm_common.values import parameter, real, whole

#: Share of the difference by which the normal sharpness follows each image.
FORGETTING = 0.02
#: After a change the centre goes back by this many images: somebody who walks in changes little at first.
BEFORE = 6
#: Most images that are used for a motion, and fewest that are needed.
IMAGES, FEWEST = 5, 3
#: How far from the expected place the focus is sought, and step of that grid, in depths of focus.
REACH, GRID = 12.0, 0.25
#: Changes of speed that are tried at each image, in depths of focus per second.
SPEEDS = 5.0 * np.arange(-3, 4)
#: Least distance of the end of the range from what the mirror refuses, in depths of focus.
STEP_BACK = 0.25
#: Standard deviations of the previous estimates of place [depths of focus] and speed [depths of focus per second].
PLACE_SIGMA, SPEED_SIGMA = 3.0, 8.0
#: Share of the difference by which the mean period follows each image, and longest period that counts [s].
PERIOD_SHARE, PERIOD_MAX = 0.3, 0.3


@dataclass(frozen=True)
class TrackConfig:
    """How to stay on the peak."""

    dither: float = parameter(
        real(0.5, 0.0, 10.0),
        "Tracking: distance of the trials below and above the focus, in units of the finest step; 0 = only watch.",
    )
    drop: float = parameter(real(0.3, 0.01, 0.99), "Tracking: relative loss of sharpness that starts a new search.")
    patience: int = parameter(whole(3, 1, 1000), "Tracking: number of images in a row that must show this loss.")
    wait: float = parameter(
        real(1.0, 0.0, 60.0, "s"),
        "Tracking: how long the object may be hidden, for example by a passer-by, before a new search begins.",
    )


class Tracker:
    """Follows a peak that was found: small trials below and above it; `lost` once the sharpness has dropped.

    A lost peak needs a new `PeakSearch`. Slow changes of the scene are accepted as normal. Somebody who walks through
    the region changes the sharpness suddenly, up or down, and is gone soon: the focus goes back to where it was before,
    and waits.

    Args:
        peak: what was found.
        search: range and tolerance of the search.
        config: how to stay on it.

    Attributes:
        centre: estimated place of the peak [1/m].
        sharpness: the normal sharpness there.
        step: where to measure next.
        lost: a new search is needed.
        hidden: the sharpness changed suddenly, and may return.
        found: whether there is an object at the peak; False = a search found none: what comes is searched.
    """

    def __init__(self, peak: Peak, search: SearchConfig, config: TrackConfig) -> None:
        self.centre, self.sharpness = peak.curvature, peak.sharpness
        self.lost = self.hidden = False
        self.found = True
        self._search, self._config = search, config
        self._dither = config.dither * search.tolerance
        self._changed, self._since = 0, math.nan
        self._before = deque([self.centre], maxlen=BEFORE)
        self._trial: deque[float] = deque()
        self.step = Step(self.centre)

    def feed(self, sharpness: float, images: Sequence[NDArray] = (), time: float = math.nan) -> None:
        """Report what was measured at `step`.

        Args:
            sharpness: of the images.
            images: grey levels, (H, W) each; used by trackers that know the camera.
            time: when they were exposed [s].

        Raises:
            ValueError: the sharpness is not a finite number.
        """
        self._watch(sharpness, time)
        if self.hidden:
            self._trial.clear()
            self.step = Step(self.centre)
        elif self._dither > 0:
            self._trial.append(sharpness)
            if len(self._trial) == 3:
                self._move()
            offset = (0.0, -self._dither, self._dither)[len(self._trial)]
            self.step = Step(self._inside(self.centre + offset))

    def refuse(self, low: float, high: float) -> None:
        """Report that the mirror cannot take `step`: the range ends before it.

        Args:
            low, high: approximate range that it reaches now [1/m]; NaN = not known.

        Raises:
            ValueError: hardly anything of the range is left.
        """
        search, here = self._search, self.step.curvature
        middle = (low + high) / 2
        if here < (middle if math.isfinite(middle) else (search.low + search.high) / 2):
            self._search = replace(search, low=max(here + STEP_BACK * search.tolerance, low))
        else:
            self._search = replace(search, high=min(here - STEP_BACK * search.tolerance, high))
        self._search.check_left()
        self._trial.clear()
        self.centre, self.step = self._inside(self.centre), Step(self._inside(here))

    def _inside(self, place: float) -> float:
        return min(max(place, self._search.low), self._search.high)

    def _watch(self, sharpness: float, time: float) -> None:
        """Update whether the peak is hidden or lost, by the sharpness of an image."""
        if not math.isfinite(sharpness):
            raise ValueError(f"sharpness = {sharpness}: must be a finite number")
        least = 1 - self._config.drop
        dull = sharpness < least * self.sharpness
        if not (dull or least * sharpness > self.sharpness):
            self.sharpness += FORGETTING * (sharpness - self.sharpness)
            self._changed, self.hidden = 0, False
            self._before.append(self.centre)
            return
        self._changed += 1
        if self._changed < self._config.patience:
            return
        if not self.hidden:
            self.hidden, self._since, self.centre = True, time, self._before[0]
        if not time - self._since < self._config.wait:  # without times it counts as lost at once
            self.lost = self.lost or dull or not self.found
            if not dull:
                self.sharpness, self._changed, self.hidden = sharpness, 0, False

    def _move(self) -> None:
        """After three trials, at the centre, below and above: go towards the top of their parabola."""
        middle, below, above = self._trial
        self._trial.clear()
        bend = below - 2 * middle + above
        # A quarter of the way: noise moves the centre little, and a drift is still followed.
        share = 0.5 * (below - above) / bend if bend < 0 else float(np.sign(above - below))
        self.centre = self._inside(self.centre + 0.25 * self._dither * min(max(share, -2.0), 2.0))


class MotionTracker(Tracker):
    """A tracker for a known camera and mirror.

    Args:
        peak, search, config: as of a `Tracker`, with a dither above 0.
        model: of the camera.

    Attributes:
        speed: of the focus [1/m per s].
    """

    def __init__(self, peak: Peak, search: SearchConfig, config: TrackConfig, model: DefocusModel) -> None:
        super().__init__(peak, search, config)
        self.speed = 0.0
        self._model = model
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
        inside = self._inside(self.centre)
        if inside != self.centre:
            self.centre, self.speed = inside, 0.0
        self._aim()

    def _estimate(self) -> None:
        """Estimate place and speed from the latest images."""
        times, places, powers = (np.array(part) for part in zip(*self._images, strict=True))
        tolerance, ago = self._search.tolerance, times[-1] - times
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
        """Choose the next image: at the expected place of the focus, alternately below and above it."""
        self._sign = -self._sign
        self.step = Step(self._inside(self.centre + self.speed * self._period + self._sign * self._dither))
