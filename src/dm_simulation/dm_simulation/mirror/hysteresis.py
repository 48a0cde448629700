"""Hysteresis laws of piezo ceramics: rate-independent, one state per actuator, vectorised over actuators.

Each law is a straight line, which is reversible, plus a part m that depends on the past: y = scale (u + weight m[u]).
Weight and scale of each actuator follow from simulated full cycles, such that y spans 2 over signals -1..+1 (in units
of half the stroke) and the largest opening of the loop is `fraction` of the total stroke, which is how vendors state
hysteresis.
"""

import copy
from collections.abc import Callable
from typing import Protocol

import numpy as np

from dm_simulation.mirror.preisach import PreisachOperator, drawn_density
from dm_simulation.mirror.zernike import Array

#: Largest integration steps of the Bouc-Wen and of the Jiles-Atherton law, in normalised signal.
BOUC_WEN_STEP, JILES_ATHERTON_STEP = 0.02, 0.005
#: Points of a sweep and number of cycles with which the opening of a loop is found.
SWEEP_POINTS, SWEEP_CYCLES = 61, 2
#: Ranges of drawn Bouc-Wen laws: order, `onward` of rising and of falling moves, `back`.
BOUC_WEN_RANGES = (0.8, 3.0), (1.5, 3.0), (1.5, 3.0), (0.3, 1.2)
#: Largest width of drawn loops, as a share of the largest that their law can have.
WIDEST = 0.8


class HysteresisLaw(Protocol):
    """The part m of the response that depends on the past."""

    def move(self, u: Array) -> Array:
        """Go monotonically from the last signals to `u` (N,) and return m (N,)."""


def prandtl_ishlinskii_density(v: Array, r: Array) -> Array:
    """Density of relays that falls exponentially with the half-width r, at any centre v: loops are symmetric."""
    return np.exp(-r / 0.25) + 0.0 * v


def skew_density(v: Array, r: Array) -> Array:
    """Density of relays that is larger at positive centres v; positive over the whole range of the electronics."""
    return np.exp(-r / 0.3) * (1 + 0.45 * v - 0.12 * v * v)


class BoucWenHysteresis:
    """Bouc-Wen law of any order n, m = -z: dz/d|u| = 1 - onward |z|^n, with -back for onward where z opposes the move.

    The generalised law of [20] with three constants: z saturates earlier on falling than on rising moves if the two
    values of `onward` differ. [19] with n = 1 is onward = beta + gamma, back = beta - gamma. The law has no
    return-point memory: a minor loop does not close exactly.

    Args:
        order, rising, falling, back: n, `onward` of rising and of falling moves, `back`; numbers, or (N,).
    """

    def __init__(
        self, count: int, order: Array | float, rising: Array | float, falling: Array | float, back: Array | float
    ) -> None:
        self._order, self._back = order, back
        self._rising, self._falling = rising, falling
        self._z = np.zeros(count)
        self._u = np.zeros(count)

    def move(self, u: Array) -> Array:
        way, left = np.sign(u - self._u), np.abs(u - self._u)
        onward = np.where(way > 0, self._rising, self._falling)
        z = way * self._z  # a falling move is a rising one with both signs turned

        def slope(z: Array) -> Array:
            return 1 - np.where(z > 0, onward, -np.asarray(self._back)) * np.abs(z) ** self._order

        steps = max(1, int(np.ceil(left.max() / BOUC_WEN_STEP)))
        step = left / steps
        for _ in range(steps):  # Runge-Kutta of order 4
            first = slope(z)
            second = slope(z + step / 2 * first)
            third = slope(z + step / 2 * second)
            z = z + step / 6 * (first + 2 * second + 2 * third + slope(z + step * third))
        self._z = np.where(way == 0, self._z, way * z)
        self._u = np.array(u, float)
        return -self._z


class JilesAthertonHysteresis:
    """The domain wall law of [36], which [37] applies to piezo ceramics; tanh is the anhysteretic curve.

    Walls are pinned: m approaches that curve only on moves towards it, the more slowly the stronger the pinning, and
    follows a share of its slope reversibly. Minor loops neither close nor erase earlier turning points. Simplified: m
    adds to the signal, but not to its change. All take the steps of the longest move, which errs by 3 nm at most.

    Args:
        width, pinning, reversible, coupling: (N,) width of tanh, pinning, reversible share, weight of m in the signal.
    """

    def __init__(self, count: int, width: Array, pinning: Array, reversible: Array, coupling: Array) -> None:
        self._width, self._pinning = width, pinning
        self._reversible, self._coupling = reversible, coupling
        self._m = np.zeros(count)
        self._u = np.zeros(count)

    def move(self, u: Array) -> Array:
        steps = max(1, int(np.ceil(np.abs(u - self._u).max() / JILES_ATHERTON_STEP)))
        step, m = (u - self._u) / steps, self._m
        for number in range(steps):
            ideal = np.tanh((self._u + (number + 0.5) * step + self._coupling * m) / self._width)
            pinned = np.maximum((ideal - m) * np.sign(step), 0.0) / self._pinning
            m = m + step * ((1.0 - self._reversible) * pinned + self._reversible * (1.0 - ideal**2) / self._width)
        self._m, self._u = m, np.array(u, float)
        return m


class MixedHysteresis:
    """A weighted sum of laws; without any law 0, as for a linear actuator."""

    def __init__(self, parts: tuple[tuple[Array | float, HysteresisLaw], ...]) -> None:
        self._parts = parts

    def move(self, u: Array) -> Array:
        return np.sum([weight * law.move(u) for weight, law in self._parts], axis=0)


def _drawn_constants(count: int, rng: np.random.Generator, *ranges: tuple[float, float]) -> Array:
    """Constants (C, N): one of the mirror within each range, about which those of its actuators scatter by a tenth."""
    middle = [rng.uniform(low, high) for low, high in ranges]
    return np.exp(0.1 * rng.standard_normal((len(ranges), count))) * np.array(middle)[:, None]


def _drawn_preisach(count: int, rng: np.random.Generator) -> HysteresisLaw:
    return PreisachOperator(count, drawn_density(count, rng))


def _drawn_bouc_wen(count: int, rng: np.random.Generator) -> HysteresisLaw:
    return BoucWenHysteresis(count, *_drawn_constants(count, rng, *BOUC_WEN_RANGES))


def _drawn_jiles_atherton(count: int, rng: np.random.Generator) -> HysteresisLaw:
    return JilesAthertonHysteresis(
        count, *_drawn_constants(count, rng, (0.5, 1.2), (0.2, 0.5), (0.1, 0.4), (0.02, 0.1))
    )


def _drawn_mixed(count: int, rng: np.random.Generator) -> HysteresisLaw:
    """A mixture of Preisach's and the Bouc-Wen law, with shares that differ between the actuators."""
    share = np.clip(rng.uniform(0.2, 0.8) + 0.1 * rng.standard_normal(count), 0.0, 1.0)
    return _in_parts(share, _drawn_preisach(count, rng), _drawn_bouc_wen(count, rng))


def _drawn_unlike(count: int, rng: np.random.Generator) -> HysteresisLaw:
    """Actuators that differ as much as those of different mirrors: Preisach, for half of them mixed with Bouc-Wen."""
    densities = [drawn_density(1, rng) for _ in range(count)]
    preisach = PreisachOperator(count, lambda v, r: np.concatenate([density(v, r) for density in densities]))
    bouc_wen = BoucWenHysteresis(count, *(rng.uniform(*bounds, count) for bounds in BOUC_WEN_RANGES))
    return _in_parts(1.0 - rng.uniform(0.2, 0.5, count) * (rng.random(count) < 0.5), preisach, bouc_wen)


def _in_parts(share: Array, first: HysteresisLaw, second: HysteresisLaw) -> HysteresisLaw:
    """`share` (N,) of the first law plus the rest of the second, each normalised to the same loop opening."""
    parts = []
    for law, part in ((first, share), (second, 1 - share)):
        rising, falling = _full_loop(law, len(share))
        parts.append((part / np.max(falling - rising, axis=0), law))
    return MixedHysteresis(tuple(parts))


def _mixed(count: int, _rng: np.random.Generator) -> HysteresisLaw:
    bouc_wen = BoucWenHysteresis(count, 2.0, 2.0, 3.2, 0.8)
    return MixedHysteresis(((4.0, PreisachOperator(count, skew_density)), (0.5, bouc_wen)))


#: Laws by name. Those that begin with `drawn` are drawn at random, one for each actuator; the others are common to all
#: actuators.
LAWS: dict[str, Callable[[int, np.random.Generator], HysteresisLaw]] = {
    "none": lambda count, rng: MixedHysteresis(()),
    "prandtl_ishlinskii": lambda count, rng: PreisachOperator(count, prandtl_ishlinskii_density),
    "preisach": lambda count, rng: PreisachOperator(count, skew_density),
    "bouc_wen": lambda count, rng: BoucWenHysteresis(count, 1.0, 2.2, 2.2, 1.0),
    "mixed": _mixed,
    "drawn_preisach": _drawn_preisach,
    "drawn_bouc_wen": _drawn_bouc_wen,
    "drawn_mixed": _drawn_mixed,
    "drawn_unlike": _drawn_unlike,
    "drawn_jiles_atherton": _drawn_jiles_atherton,
}


class Hysteresis:
    """A law for `count` actuators.

    Args:
        law: one of LAWS.
        fraction: largest opening of the full loop over -1..+1, as a fraction of the total stroke; a number, or (N,).
        rng: draws the law if it is one of those drawn at random.

    Raises:
        ValueError: unknown law, or an opening that the law cannot reach.
    """

    def __init__(self, law: str, fraction: Array | float, count: int, rng: np.random.Generator | None = None) -> None:
        if law not in LAWS:
            raise ValueError(f"piezo.law = {law!r}: must be one of {', '.join(LAWS)}")
        self._law = LAWS[law](count, rng if rng is not None else np.random.default_rng(0))
        self._weight, self._scale = np.zeros(count), np.ones(count)
        if law != "none" and np.any(fraction):
            self._weight, self._scale = _weight_and_scale(law, self._law, np.broadcast_to(fraction, count))

    def move(self, u: Array) -> Array:
        """Go to signals u (N,) and return y (N,), in units of half the total stroke."""
        return self._scale * (u + self._weight * self._law.move(u))


def _full_loop(law: HysteresisLaw, count: int) -> tuple[Array, Array]:
    """m on the rising and the falling branch (SWEEP_POINTS, N) of a steady full cycle, both in order of the signal."""
    trial = copy.deepcopy(law)
    grid = np.linspace(-1, 1, SWEEP_POINTS)

    def sweep(signals: Array) -> Array:
        return np.array([trial.move(np.full(count, u)) for u in signals])

    for _ in range(SWEEP_CYCLES):
        rising, falling = sweep(grid), sweep(grid[::-1])[::-1]
    return rising, falling


def _weight_and_scale(name: str, law: HysteresisLaw, fraction: Array) -> tuple[Array, Array]:
    """Weight (N,) of the law and scale (N,) of the sum for the required openings (N,)."""
    rising, falling = _full_loop(law, len(fraction))
    opening, span = np.max(falling - rising, axis=0), rising[-1] - rising[0]
    setting = f"piezo.hysteresis = {fraction.max():g}"
    # fraction = weight * opening / (2 + weight * span)
    if name.startswith("drawn"):
        fraction = np.where(span > 0, np.minimum(fraction, WIDEST * opening / np.maximum(span, 1e-9)), fraction)
    free = opening - fraction * span
    if np.any(free <= 0):
        raise ValueError(f"{setting}: {name} reaches at most {np.min(opening / span):.2f}")
    weight = 2 * fraction / free
    steepest = np.min(np.diff(rising, axis=0), axis=0) / (2 / (SWEEP_POINTS - 1))
    if np.any(1 + weight * steepest <= 0):
        raise ValueError(f"{setting}: too wide, {name} would no longer rise with the signal")
    return weight, 2 / (2 + weight * span)
