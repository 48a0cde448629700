"""Staying on the sharpest focus: a state machine like `PeakSearch`, for a scene that changes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.peak_search import Step


@dataclass(frozen=True)
class TrackConfig:
    """How to stay on the peak.

    Attributes:
        dither: the focus is tried this far below and above [1/m]; 0 = it stands still and is only watched.
        drop: relative loss of sharpness that means: lost, search again; 0..1.
        patience: images in a row that must have lost it.
        wait: s after which it counts as lost: until then it may be hidden, and the focus stands still.
    """

    dither: float = 0.0
    drop: float = 0.3
    patience: int = 3
    wait: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dither) and self.dither >= 0):
            raise ValueError(f"dither = {self.dither} 1/m: must be 0 or more")
        if not 0 < self.drop < 1:
            raise ValueError(f"drop = {self.drop}: must lie between 0 and 1")
        if self.patience < 1:
            raise ValueError(f"patience = {self.patience}: must be at least 1")
        if not self.wait >= 0:
            raise ValueError(f"wait = {self.wait} s: must not be negative")


@dataclass
class Tracker:
    """Follows a peak that was found: small trials below and above, and `lost` when the sharpness has dropped.

    What a lost peak needs is a new `PeakSearch`. Slow changes of the scene are taken as the new normal. Somebody who
    walks through the region changes it at once, to either side, and is gone soon: the focus goes back to where it was
    before, and waits.

    Attributes:
        centre: where the peak is believed to be [1/m].
        sharpness: the normal sharpness there.
        low, high: range of curvatures [1/m].
        step: where to measure next.
        lost: search again.
        hidden: the sharpness is another one at once, and may come back.
    """

    centre: float
    sharpness: float
    low: float
    high: float
    config: TrackConfig = field(default_factory=TrackConfig)

    #: Share by which the normal sharpness follows each image.
    FORGETTING = 0.02
    #: Images before a change whose centre is gone back to: who comes in changes little at first.
    BEFORE = 6

    def __post_init__(self) -> None:
        self.lost = self.hidden = False
        self._changed, self._since = 0, math.nan
        self._before = deque([self.centre], maxlen=self.BEFORE)
        self._trial: deque[float] = deque()
        self.step = Step(self.centre)

    def feed(self, sharpness: float, images: Sequence[NDArray] = (), time: float = math.nan) -> None:
        """Report what was measured at `step`.

        Args:
            sharpness: of the images.
            images: grey levels, (H, W) each; what knows the camera learns from them.
            time: when they were exposed [s].

        Raises:
            ValueError: the sharpness is not a finite number.
        """
        self._watch(sharpness, time)
        if self.hidden:
            self._trial.clear()
            self.step = Step(self.centre)
        elif self.config.dither > 0:
            self._trial.append(sharpness)
            if len(self._trial) == 3:
                self._move()
            self.step = Step(min(max(self.centre + self._offset(), self.low), self.high))

    def _watch(self, sharpness: float, time: float) -> None:
        """Whether the peak is hidden or lost, by the sharpness of an image."""
        if not math.isfinite(sharpness):
            raise ValueError(f"sharpness = {sharpness}: must be a finite number")
        least = 1 - self.config.drop
        dull = sharpness < least * self.sharpness
        if not (dull or least * sharpness > self.sharpness):
            self.sharpness += self.FORGETTING * (sharpness - self.sharpness)
            self._changed, self.hidden = 0, False
            self._before.append(self.centre)
            return
        self._changed += 1
        if self._changed < self.config.patience:
            return
        if not self.hidden:
            self.hidden, self._since, self.centre = True, time, self._before[0]
        if not time - self._since < self.config.wait:  # without times it counts as lost at once
            self.lost = self.lost or dull
            if not dull:
                self.sharpness, self._changed, self.hidden = sharpness, 0, False

    def _offset(self) -> float:
        return (0.0, -self.config.dither, self.config.dither)[len(self._trial)]

    def _move(self) -> None:
        """Three trials, at the centre, below and above: go towards the top of their parabola."""
        middle, below, above = self._trial
        self._trial.clear()
        bend = below - 2 * middle + above
        # A quarter of the way: noise moves the centre little, and a drift is still followed.
        share = 0.5 * (below - above) / bend if bend < 0 else float(np.sign(above - below))
        self.centre += 0.25 * self.config.dither * min(max(share, -2.0), 2.0)
        self.centre = min(max(self.centre, self.low), self.high)
