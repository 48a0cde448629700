"""Staying on the sharpest focus: a state machine like `PeakSearch`, for a scene that changes."""

from __future__ import annotations

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
    """

    dither: float = 0.0
    drop: float = 0.3
    patience: int = 3

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dither) and self.dither >= 0):
            raise ValueError(f"dither = {self.dither} 1/m: must be 0 or more")
        if not 0 < self.drop < 1:
            raise ValueError(f"drop = {self.drop}: must lie between 0 and 1")
        if self.patience < 1:
            raise ValueError(f"patience = {self.patience}: must be at least 1")


@dataclass
class Tracker:
    """Follows a peak that was found: small trials below and above, and `lost` when the sharpness has dropped.

    What a lost peak needs is a new `PeakSearch`. Slow changes of the scene are taken as the new normal.

    Attributes:
        centre: where the peak is believed to be [1/m].
        sharpness: the normal sharpness there.
        low, high: range of curvatures [1/m].
        step: where to measure next.
        lost: search again.
    """

    centre: float
    sharpness: float
    low: float
    high: float
    config: TrackConfig = field(default_factory=TrackConfig)

    #: Share by which the normal sharpness follows each image.
    FORGETTING = 0.02

    def __post_init__(self) -> None:
        self.lost = False
        self._dull = 0
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
        self._watch(sharpness)
        if self.config.dither > 0:
            self._trial.append(sharpness)
            if len(self._trial) == 3:
                self._move()
            self.step = Step(min(max(self.centre + self._offset(), self.low), self.high))

    def _watch(self, sharpness: float) -> None:
        """Whether the peak is lost, by the sharpness of an image."""
        if not math.isfinite(sharpness):
            raise ValueError(f"sharpness = {sharpness}: must be a finite number")
        dull = sharpness < (1 - self.config.drop) * self.sharpness
        self._dull = self._dull + 1 if dull else 0
        self.lost = self.lost or self._dull >= self.config.patience
        if not dull:
            self.sharpness += self.FORGETTING * (sharpness - self.sharpness)

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
