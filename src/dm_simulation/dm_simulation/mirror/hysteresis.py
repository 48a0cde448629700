"""Hysteresis laws of piezo ceramics: rate-independent, one state per actuator, vectorised over actuators.

Each law is a reversible straight line plus a part m that depends on the past: y = scale (u + weight m[u]). Weight and
scale follow from a simulated full cycle, such that y spans 2 over signals -1..+1 (total stroke 1 in units of half the
stroke each way) and the loop opens by `fraction` of the total stroke where it is widest, which is how vendors state
hysteresis.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache

import numpy as np

from dm_simulation.mirror.zernike import Array


class HysteresisLaw(ABC):
    """The part of the response that depends on the past. `move(u)` takes signals (N,) and returns m (N,)."""

    @abstractmethod
    def move(self, u: Array) -> Array:
        """Go monotonically from the last signals to `u`."""


class NoHysteresis(HysteresisLaw):
    """A linear actuator."""

    def __init__(self, count: int) -> None:
        self._zero = np.zeros(count)

    def move(self, u: Array) -> Array:
        return self._zero


class PlayHysteresis(HysteresisLaw):
    """Prandtl-Ishlinskii: a weighted sum of play (backlash) operators with 40 half-widths.

    Weights fall exponentially with the half-width, so that small moves have narrow loops. The loops are symmetric.
    """

    def __init__(self, count: int, radii: int = 40, decay: float = 0.25) -> None:
        self._radius = (np.arange(radii) + 0.5) / radii
        self._weight = np.exp(-self._radius / decay) / radii
        self._play = np.zeros((count, radii))

    def move(self, u: Array) -> Array:
        u = u[:, None]
        np.clip(self._play, u - self._radius, u + self._radius, out=self._play)
        return self._play @ self._weight


class PreisachHysteresis(HysteresisLaw):
    """Preisach operator: relays switching up at v + r and down at v - r, with a density that is not symmetric in v.

    The relays of half-width r that are up are those with v below the value of a play operator of that half-width ([16],
    section 2.4), so the density integrated over v up to the play value is the output. That is continuous in u, where a
    grid of relays would climb in stairs. Density: exp(-r/decay) (1 + skew v - bend v^2), positive over the whole range
    of the electronics.
    """

    def __init__(
        self, count: int, radii: int = 128, decay: float = 0.3, skew: float = 0.45, bend: float = 0.12
    ) -> None:
        self._radius = (np.arange(radii) + 0.5) / radii
        self._weight = np.exp(-self._radius / decay) / radii
        self._decay = decay
        self._skew = skew
        self._bend = bend
        self._interface = np.zeros((count, radii))

    def density(self, v: Array, r: Array) -> Array:
        """Density of relays at centre v and half-width r, per unit of each."""
        return np.exp(-r / self._decay) * (1 + self._skew * v - self._bend * v * v)

    def move(self, u: Array) -> Array:
        v = self._interface
        np.clip(v, u[:, None] - self._radius, u[:, None] + self._radius, out=v)
        return (v * (1 + v * (self._skew / 2 - v * (self._bend / 3)))) @ self._weight


class BoucWenHysteresis(HysteresisLaw):
    """Bouc-Wen: dz = du - (beta |du| z + gamma du |z|), the lag -z ([19] with n = 1).

    For n = 1 every monotone move has a closed form, so the result does not depend on how a move is cut into steps. The
    law has no return-point memory: a minor loop does not close exactly.
    """

    def __init__(self, count: int, beta: float = 1.6, gamma: float = 0.6) -> None:
        self._rising = beta + gamma
        self._returning = beta - gamma
        self._z = np.zeros(count)
        self._u = np.zeros(count)

    def move(self, u: Array) -> Array:
        way = np.sign(u - self._u)
        left = np.abs(u - self._u)
        z = way * self._z  # a falling move is a rising one with both signs turned
        # While z < 0: dz/du = 1 - returning z. It reaches zero after `to_zero`.
        below = np.minimum(z, 0.0)
        to_zero = np.log1p(-self._returning * below) / self._returning
        first = np.minimum(left, to_zero)
        limit = 1 / self._returning
        z_below = limit + (below - limit) * np.exp(-self._returning * first)
        # From zero on: dz/du = 1 - rising z.
        start = np.maximum(z, 0.0)
        limit = 1 / self._rising
        z_above = limit + (start - limit) * np.exp(-self._rising * (left - first))
        moved = np.where((z < 0) & (left <= to_zero), z_below, z_above)
        self._z = np.where(way == 0, self._z, way * moved)
        self._u = np.array(u, float)
        return -self._z


class AsymmetricBoucWenHysteresis(HysteresisLaw):
    """Bouc-Wen of order 2 that saturates earlier on falling than on rising moves, the lag -z.

    Along the way, dz/d|u| = 1 - onward z^2 where z points along the way and 1 + back z^2 where it points against it
    (the generalised law of [20] with three constants). Monotone moves have a closed form.
    """

    def __init__(self, count: int, onward: tuple[float, float] = (2.0, 3.2), back: float = 0.8) -> None:
        self._onward = onward
        self._back = back
        self._z = np.zeros(count)
        self._u = np.zeros(count)

    def move(self, u: Array) -> Array:
        way = np.sign(u - self._u)
        left = np.abs(u - self._u)
        z = way * self._z
        # While z < 0 it is a tangent of the way, which reaches zero after `to_zero`.
        rate = np.sqrt(self._back)
        angle = np.arctan(rate * np.minimum(z, 0.0))
        to_zero = -angle / rate
        first = np.minimum(left, to_zero)
        z_below = np.tan(angle + rate * first) / rate
        # From zero on a hyperbolic tangent.
        limit = 1 / np.sqrt(np.where(way < 0, self._onward[1], self._onward[0]))
        start = np.minimum(np.maximum(z, 0.0) / limit, 1 - 1e-12)
        z_above = limit * np.tanh(np.arctanh(start) + (left - first) / limit)
        moved = np.where((z < 0) & (left <= to_zero), z_below, z_above)
        self._z = np.where(way == 0, self._z, way * moved)
        self._u = np.array(u, float)
        return -self._z


class MixedHysteresis(HysteresisLaw):
    """Half the loop by a Preisach operator, half by an asymmetric Bouc-Wen law of order 2."""

    def __init__(self, count: int, preisach: float = 4.0, bouc_wen: float = 0.5) -> None:
        self._preisach = PreisachHysteresis(count)
        self._bouc_wen = AsymmetricBoucWenHysteresis(count)
        self._weight = (preisach, bouc_wen)

    def move(self, u: Array) -> Array:
        return self._weight[0] * self._preisach.move(u) + self._weight[1] * self._bouc_wen.move(u)


_LAWS = {
    "none": NoHysteresis,
    "prandtl_ishlinskii": PlayHysteresis,
    "preisach": PreisachHysteresis,
    "bouc_wen": BoucWenHysteresis,
    "mixed": MixedHysteresis,
}
LAWS = tuple(_LAWS)


class Hysteresis:
    """A law for `count` actuators with the same shape.

    Args:
        law: one of LAWS.
        fraction: largest opening of the full loop over -1..+1, as a fraction of the total stroke.

    Raises:
        ValueError: unknown law, or an opening that the law cannot reach.
    """

    def __init__(self, law: str, fraction: float, count: int) -> None:
        if law not in _LAWS:
            raise ValueError(f"piezo.law = {law!r}: must be one of {', '.join(LAWS)}")
        self._weight, self._scale = _weight_and_scale(law, fraction)
        self._law: HysteresisLaw = _LAWS[law](count)

    def move(self, u: Array) -> Array:
        """Go to signals u (N,) and return y (N,), in units of half the total stroke."""
        return self._scale * (u + self._weight * self._law.move(u))


@cache
def _weight_and_scale(law: str, fraction: float) -> tuple[float, float]:
    """Weight of the law and scale of the whole for the wanted opening, from a steady full cycle."""
    if law == "none" or fraction == 0:
        return 0.0, 1.0
    grid = np.linspace(-1, 1, 801)
    trial = _LAWS[law](1)

    def sweep(signals: Array) -> Array:
        return np.array([trial.move(np.array([u]))[0] for u in signals])

    for _ in range(4):
        rising, falling = sweep(grid), sweep(grid[::-1])[::-1]
    opening = float(np.max(falling - rising))
    span = float(rising[-1] - rising[0])
    # fraction = weight * opening / (2 + weight * span)
    if fraction * span >= opening:
        raise ValueError(f"piezo.hysteresis = {fraction:g}: {law} reaches at most {opening / span:.2f}")
    weight = 2 * fraction / (opening - fraction * span)
    if 1 + weight * np.min(np.diff(rising) / np.diff(grid)) <= 0:
        raise ValueError(f"piezo.hysteresis = {fraction:g}: too wide, {law} would no longer rise with the signal")
    return weight, 2 / (2 + weight * span)
