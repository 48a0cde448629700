"""The bench of closed loops without ROS: a linear mirror with faults that its calibration does not know."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dm_common.limits import Limits
from dm_common.measurement import Measurement
from dm_common.optics.zernike import TERM_RMS
from dm_common.recipes import Recipe
from dm_controller.planning.target import FocusTarget
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model

LIMITS = Limits(-1.0, 1.0, np.asarray(make_mirror().limits.pairs, dtype=np.intp), 2.0)
MIRROR = LinearMirror(*hexagon())
#: What is known of it.
MODEL = perfect_model(MIRROR)


class LinearPlant:
    """Implements dm_common.measurement.Bench; settling takes half a second, and so does a map.

    Args:
        gains: (37,) or one for all, relative to those of the calibration.
        noise: m, of each term of a map, as rms sag.
        backlash: half-width, in signals, within which an actuator stays where it is.
        drift: share of the first command that is added per decade of time.

    Attributes:
        calls: degauss, apply and measure in order.
        commands: signals (37,) of each.
        disturb: {number of a map: added defocus, m}.
    """

    def __init__(
        self, gains: ArrayLike = 1.0, noise: float = 0.0, backlash: float = 0.0, drift: float = 0.0, seed: int = 4
    ) -> None:
        self.gains = np.broadcast_to(np.asarray(gains, dtype=np.float64), 37)
        self.noise, self.backlash, self.drift = noise, backlash, drift
        self.random = np.random.default_rng(seed)
        self.position: NDArray[np.float64] = np.zeros(37)
        self.time = self.began = 0.0
        self.calls: list[str] = []
        self.commands: list[NDArray[np.float64]] = []
        self.disturb: dict[int, float] = {}

    @property
    def maps(self) -> int:
        return self.calls.count("measure")

    def degauss(self) -> None:
        self.calls.append("degauss")
        self.position = np.zeros(37)

    def apply(self, signals: NDArray[np.float64]) -> NDArray[np.float64]:
        assert LIMITS.allow(signals)
        if not self.commands:
            self.began = self.time
        self.calls.append("apply")
        self.commands.append(signals)
        self.position = np.clip(self.position, signals - self.backlash, signals + self.backlash)
        return signals

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        self.time += 0.5
        return True

    def measure(self, label: str) -> Measurement:
        self.calls.append("measure")
        self.time += 0.5
        drifted = self.drift * math.log10(max(self.time - self.began, 0.1)) * self.commands[0]
        errors = self.noise * self.random.standard_normal(21) / TERM_RMS
        errors[3] += self.disturb.get(self.maps, 0.0)
        sag = MIRROR.sag(self.gains * (self.position + drifted)) + MIRROR.modes @ errors
        return MIRROR.measurement(sag, round(self.time * 1e9), sigma=np.zeros(21), residual_rms=0.0, valid_fraction=1.0)

    def left(self, recipe: Recipe) -> float:
        """Largest coefficient error that the recipe truly leaves, m."""
        wanted = FocusTarget(recipe.curvature).coefficients(RADIUS)
        return float(np.abs(MIRROR.fit_terms(MIRROR.sag(self.gains * recipe.effective)) - wanted)[3:].max())
