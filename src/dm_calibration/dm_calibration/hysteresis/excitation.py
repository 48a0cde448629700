"""Commands that show hysteresis and creep of all actuators at once.

Random shapes turn every actuator in nearly every step, over swings from small to the full range, each in its own order.
A map measures the displacements of all N actuators, so one run serves all of them. Once the random shapes show roughly
where the mirror is flat, every other shape is an *in-use* shape, similar to a request: a low-order shape about the flat
mirror, with random signals of each actuator on top. Actuators that flatten a figure then stay near an end of their
range, which random shapes rarely reach. Creep over minutes shows only if the mean shape over minutes is not flat: the
first half of the in-use shapes bend the mirror one way, the second half the other way. Some random shapes are held; the
first half of these is close to a bowl, the second half to its inverse. Maps taken early show creep of the first second.
The last fifth consists of in-use moves only, to test the law found from the others. A degauss precedes them, and a
second one comes halfway if they are many. Only maps after a degauss show the offset between demagnetised actuators and
the mean of their loops; without them it is fitted as part of the figure, and requests after a degauss have an offset.
"""

from dataclasses import dataclass

import numpy as np

from dm_calibration.influence.regression import TooFewMapsError
from dm_common import Bools, Floats
from dm_common.mirror import Mirror

#: Share of the maps that test the law.
CHECK_SHARE = 0.2
#: Number of test maps from which on a second degauss is made halfway through them.
CHECKS_MANY = 20
#: Repeated maps of the mirror at rest, which show the noise of a map.
REPEATS = 8
#: Fewest and most maps of a run, repeats not counted.
MAPS_MIN, MAPS_MAX = 60, 2000
#: Fewest maps per actuator: each map contributes to the gains and laws of all actuators at once.
MAPS_PER_ACTUATOR = 2
#: Swings as shares of the range: with fewer full swings, requests have larger errors (studies/comparison/NOTES.md).
SWINGS = (1.0, 1.0, 0.6, 0.3)
#: From this many maps on, a level common to all actuators takes random signals to the ends of the range. No map shows
#: a level, so shorter runs use smaller ones: after 100 to 200 maps, errors are then up to three times smaller.
WIDE_LEVELS_FROM = 250
#: Share of the shapes that are held, and range of the times for which they are held, s.
HELD_SHARE = 0.1
HELD_S = (1.0, 20.0)
#: Of the moves that test the law at least one in so many is held.
CHECK_HELD_EVERY = 8
#: Random shapes per actuator after which the flat mirror is known; after these, one shape in IN_USE_EVERY is an in-use
#: shape with random signals of amplitude SCATTER on top, as a share of half the range.
FLAT_KNOWN, IN_USE_EVERY, SCATTER = 2, 2, 0.3
#: Amplitude of the random signals on top of the moves that test the law, as a share of half the range.
CHECK_SCATTER = 0.03
#: Weight of the bowl in held random shapes; smallest curvature of in-use shapes, as a share of the largest.
BOWL, BENT = 0.7, 0.7
#: Share of the maps that are taken early, and the share of the settle time after which they are taken.
EARLY_SHARE, EARLY = 0.3, 0.2


@dataclass(frozen=True, eq=False)
class Excitation:
    """Commands in order.

    Attributes:
        signals: (M, N) shapes within the limits, without repeats; in-use shapes are relative to the flat mirror.
        dwell: (M,) s to hold each beyond the settle time before its map.
        settle_share: (M,) share of the settle time to wait.
        in_use: (M,) which are in-use shapes, including those that test the law.
        check: (M,) which shapes test the law.
    """

    signals: Floats
    dwell: Floats
    settle_share: Floats
    in_use: Bools
    check: Bools

    @property
    def degaussed(self) -> tuple[int, ...]:
        """The rows before which the mirror is degaussed."""
        checks = np.flatnonzero(self.check).tolist()
        return (checks[0], *([checks[len(checks) // 2]] if len(checks) >= CHECKS_MANY else []))


def fewest_maps(actuators: int) -> int:
    """The fewest maps from which the law of this number of actuators can be found."""
    return max(MAPS_MIN, MAPS_PER_ACTUATOR * actuators)


def excitation(mirror: Mirror, maps: int, seed: int = 0) -> Excitation:
    """`maps` commands for `mirror`; the same for the same seed.

    Raises:
        TooFewMapsError: too few maps for the number of actuators.
        ValueError: too many maps.
    """
    fewest = fewest_maps(mirror.actuators)
    if not fewest <= maps <= MAPS_MAX:
        text = f"hysteresis_maps = {maps}: must be {fewest} to {MAPS_MAX} for {mirror.actuators} actuators"
        raise TooFewMapsError(text) if maps < fewest else ValueError(text)
    return _part(mirror, maps, seed, FLAT_KNOWN * mirror.actuators, wide=maps >= WIDE_LEVELS_FROM)


def next_part(mirror: Mirror, maps: int, seed: int) -> Excitation:
    """`maps` further commands, checks included, to continue a run that is already long enough to be fitted.

    Each part bends the mirror both ways, by a few shapes each, so it shows little of creep over minutes.
    """
    return _part(mirror, maps, seed, 0, wide=False)


def _part(mirror: Mirror, maps: int, seed: int, random: int, *, wide: bool) -> Excitation:
    """`maps` commands; in-use shapes begin after the first `random` ones; levels of random shapes may be `wide`."""
    rng = np.random.default_rng(seed)
    checks = round(CHECK_SHARE * maps)
    shapes = np.vstack((_random(mirror, maps - checks, wide, rng), _as_in_use(mirror, checks, CHECK_SCATTER, rng)))
    number = np.arange(maps)
    check = number >= maps - checks
    in_use = check | ((number >= random) & (number % IN_USE_EVERY == 0))
    shapes[in_use & ~check] = _as_in_use(mirror, int((in_use & ~check).sum()), SCATTER, rng, one_way=True)
    held = rng.random(maps) < HELD_SHARE
    if held[check].sum() < checks // CHECK_HELD_EVERY:
        held[check] = np.arange(checks) % CHECK_HELD_EVERY == CHECK_HELD_EVERY // 2
    shapes[held & ~in_use] = _bowls(mirror, shapes[held & ~in_use])
    low, high = np.log(HELD_S)
    dwell = np.where(held, np.exp(rng.uniform(low, high, maps)), 0.0)
    early = ~held & ~check & (rng.random(maps) < EARLY_SHARE)
    return Excitation(shapes, dwell, np.where(early, EARLY, 1.0), in_use, check)


def _random(mirror: Mirror, count: int, wide: bool, rng: np.random.Generator) -> Floats:
    """(count, N) random signals about a common level; `wide`: nearly uniform over the range of signals."""
    limits, half_range = mirror.limits, mirror.limits.half_range
    swing = rng.choice(SWINGS, (count, 1))
    own = swing * min(half_range, 0.5 * limits.neighbour_difference)
    reach = np.minimum(2.0 * (half_range - own), half_range) if wide else np.maximum(swing * half_range - own, 0.0)
    level = reach * rng.uniform(-1.0, 1.0, (count, 1))
    shapes = limits.middle + level + own * rng.uniform(-1.0, 1.0, (count, mirror.actuators))
    return np.asarray(np.clip(shapes, limits.low, limits.high))


def _gentle(mirror: Mirror, shapes: Floats) -> Floats:
    """(...,) factor, at most 1, that brings `shapes` (..., N), in half ranges, within the limit between neighbours."""
    a, b = mirror.limits.pairs.T
    steepest = mirror.limits.half_range * np.abs(shapes[..., a] - shapes[..., b]).max(axis=-1, initial=0.0)
    return np.asarray(np.minimum(1.0, 0.999 * mirror.limits.neighbour_difference / np.maximum(steepest, 1e-12)))


def _bowls(mirror: Mirror, shapes: Floats) -> Floats:
    """`shapes` (M, N) drawn to a bowl in the first half of the rows, to its inverse in the second."""
    middle, half_range = mirror.limits.middle, mirror.limits.half_range
    squares = mirror.x**2 + mirror.y**2
    bowl = 2.0 * squares / (squares.max() or 1.0) - 1.0
    share = float(_gentle(mirror, bowl))
    bowl = share * bowl - (1.0 - share)  # its middle at the end of the range
    bent = _way(len(shapes))[:, None] * bowl
    return np.asarray((1.0 - BOWL) * shapes + BOWL * (middle + half_range * bent))


def _way(count: int) -> Floats:
    """(count,) sign of the curvature: the first half of the shapes bends one way, the second the other way."""
    return np.where(np.arange(count) < count // 2, 1.0, -1.0)


def _as_in_use(
    mirror: Mirror, count: int, scatter: float, rng: np.random.Generator, *, one_way: bool = False
) -> Floats:
    """(count, N) bowls with some astigmatism, coma and random `scatter` about a random level, inside the limits.

    Args:
        one_way: the sign of the curvature is that of :func:`_way`; otherwise it is random.
    """
    middle, half_range = mirror.limits.middle, mirror.limits.half_range
    reach = float(np.hypot(mirror.x, mirror.y).max()) or 1.0
    x, y = mirror.x / reach, mirror.y / reach
    patterns = np.stack((2.0 * (x**2 + y**2) - 1.0, x**2 - y**2, 2.0 * x * y, x * (3.0 * (x**2 + y**2) - 2.0)))
    size = rng.uniform(-1.0, 1.0, (count, len(patterns)))
    if one_way:
        size[:, 0] = _way(count) * (BENT + (1.0 - BENT) * np.abs(size[:, 0]))
    size *= np.array([0.7, 0.1, 0.1, 0.05])
    shapes = size @ patterns + scatter * rng.uniform(-1.0, 1.0, (count, mirror.actuators))
    shapes *= _gentle(mirror, shapes)[:, None]
    shapes = np.clip(shapes, -1.0, 1.0)
    # On a plate the level is only piston; on a membrane, which all actuators pull, it makes a sphere.
    room = 1.0 - np.abs(shapes).max(axis=1, keepdims=True)
    return np.asarray(middle + half_range * (shapes + room * rng.uniform(-1.0, 1.0, (count, 1))))
