"""No command breaks a limit, however commands follow each other."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.errors import ErrorCode, Refusal
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_driver.degauss import degauss_waypoints
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter, Watchdog

PAIRS = neighbour_pairs(*hexagonal_positions(37))
A, B = PAIRS.T


def make_limiter(
    low: float = -1.0, high: float = 1.0, difference: float = 1.0, step: float = 0.1, slew_rate: float = 40.0
) -> SafetyLimiter:
    return SafetyLimiter(DriverLimits(low, high, PAIRS, difference, actuators=37, step=step, slew_rate=slew_rate))


def refusal_of(limiter: SafetyLimiter, signals: object) -> Refusal:
    with pytest.raises(Refusal) as caught:
        limiter.check_shape(signals)  # type: ignore[arg-type]
    return caught.value


def at_fault(refusal: Refusal) -> list[int]:
    assert refusal.actuators is not None
    return [int(i) + 1 for i in np.flatnonzero(refusal.actuators)]


@pytest.mark.parametrize("count", [0, 36, 38])
def test_wrong_length(count: int) -> None:
    refusal = refusal_of(make_limiter(), np.zeros(count))
    assert refusal.error_code is ErrorCode.INVALID_LENGTH
    assert f"{count} values: must have 37" in str(refusal)
    assert refusal.actuators is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_finite(bad: float) -> None:
    signals = np.zeros(37)
    signals[[4, 30]] = bad
    refusal = refusal_of(make_limiter(), signals)
    assert refusal.error_code is ErrorCode.NOT_FINITE
    assert at_fault(refusal) == [5, 31]
    assert "actuator 5" in str(refusal) and "1 more" in str(refusal)


def test_out_of_range_names_actuator_value_and_range() -> None:
    signals = np.full(37, 0.5)
    signals[11] = 0.91
    refusal = refusal_of(make_limiter(-0.8, 0.9), signals)
    assert refusal.error_code is ErrorCode.OUT_OF_RANGE
    assert at_fault(refusal) == [12]
    assert "actuator 12 = 0.91: must be -0.8 to 0.9" in str(refusal)


def test_rounding_beyond_the_range_is_cut_off_not_refused() -> None:
    shape = make_limiter().check_shape(np.full(37, 1.0 + 5e-10))
    assert (shape == 1.0).all()
    refusal = refusal_of(make_limiter(), np.full(37, 1.0 + 5e-9))
    assert refusal.error_code == ErrorCode.OUT_OF_RANGE
    assert "actuator 1 = 1.000000005: must be -1 to 1" in str(refusal), "a value that is refused is not shown as 1"


def test_neighbour_difference_names_the_pair() -> None:
    signals = np.zeros(37)
    signals[0], signals[3] = 0.31, -0.3
    refusal = refusal_of(make_limiter(difference=0.6), signals)
    assert refusal.error_code is ErrorCode.NEIGHBOUR_DIFFERENCE
    assert at_fault(refusal) == [1, 4]
    assert re.search(r"actuators 1 and 4 \(0\.31 and -0\.3\) differ by 0\.61: must be at most 0\.6", str(refusal))
    signals[3] = -0.29 - 5e-9
    assert "differ by 0.600000005: must be at most 0.6" in str(refusal_of(make_limiter(difference=0.6), signals))
    signals[3] = -0.29
    make_limiter(difference=0.6).check_shape(signals)


def test_the_checked_shape_is_a_copy() -> None:
    signals = np.zeros(37)
    shape = make_limiter().check_shape(signals)
    signals[:] = 1.0
    assert (shape == 0.0).all()


def test_age_of_commands() -> None:
    limiter = SafetyLimiter(DriverLimits(actuators=37, command_age=0.5, command_lead=0.2))
    for fresh in (0.0, 0.499, -0.199):
        limiter.check_age(fresh)
    for stale, text in (
        (0.51, r"0.510 s old: must be at most 0.5 s \(limits.command_age\); do the clocks agree"),
        (-0.21, r"0.210 s in the future: must be at most 0.2 s \(limits.command_lead\); do the clocks agree"),
        (math.nan, "nan s old"),
    ):
        with pytest.raises(Refusal, match=text) as caught:
            limiter.check_age(stale)
        assert caught.value.error_code is ErrorCode.STALE


def test_a_step_that_is_too_large_is_stopped_in_front_of_the_write() -> None:
    limiter = make_limiter(step=0.1)
    limiter.check_write(np.zeros(37), np.full(37, 0.1))
    limiter.check_write(None, np.full(37, 1.0))
    with pytest.raises(Refusal, match=r"step of actuator 1 = 0\.11: must be at most 0\.1"):
        limiter.check_write(np.zeros(37), np.full(37, 0.11))
    with pytest.raises(Refusal):
        limiter.check_write(None, np.full(37, math.nan))
    with pytest.raises(Refusal):
        limiter.check_write(None, np.full(37, np.nextafter(1.0, 2.0)))
    with pytest.raises(Refusal):
        limiter.check_write(None, np.zeros(36))


#: Parameters that have another name as fields.
FIELDS = {"signal_min": "low", "signal_max": "high"}


@pytest.mark.parametrize(
    "arguments",
    [
        {"signal_min": 0.5, "signal_max": 0.5},
        {"signal_min": -1.1},
        {"signal_max": math.nan},
        {"step": 0.0},
        {"slew_rate": math.inf},
        {"neighbour_difference": -1.0},
        {"command_age": 0.0},
    ],
)
def test_impossible_limits_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=rf"limits\.{next(iter(arguments))} = "):
        DriverLimits(actuators=37, **{FIELDS.get(name, name): value for name, value in arguments.items()})  # type: ignore[arg-type]


def test_a_ramp_has_the_fewest_steps_and_ends_exactly() -> None:
    limiter = make_limiter(step=0.1, slew_rate=40.0)
    start, target = np.full(37, -1.0), np.full(37, 1.0)
    shapes = list(limiter.ramp(start, target))
    assert len(shapes) == 20
    assert shapes[-1] is target
    assert limiter.ramp_time(start, target) == pytest.approx(19 * 0.1 / 40.0)
    assert len(list(limiter.ramp(start, start))) == 1


limits = st.builds(
    lambda low, width, difference, step: (low, min(1.0, low + width), difference, step),
    st.floats(-1.0, 0.5),
    st.floats(0.1, 2.0),
    st.floats(0.05, 2.0),
    st.floats(0.01, 2.0),
)
seeds = st.integers(0, 2**32 - 1)


def legal_shape(generator: np.random.Generator, low: float, high: float, difference: float) -> np.ndarray:
    """A random shape with extreme neighbour differences, pulled towards its mean until it is legal."""
    shape = (
        generator.choice([low, high, 0.5 * (low + high)], 37)
        if generator.random() < 0.5
        else generator.uniform(low, high, 37)
    )
    largest = np.abs(shape[A] - shape[B]).max()
    if largest > difference:
        shape = shape.mean() + (shape - shape.mean()) * (difference / largest)
    return shape


@settings(max_examples=40, deadline=None)
@given(limits, seeds)
def test_no_sequence_of_requests_breaks_a_limit(values: tuple[float, float, float, float], seed: int) -> None:
    """Legal, illegal and degauss requests in any order, each left for the next after any number of writes."""
    low, high, difference, step = values
    limiter = make_limiter(low, high, difference, step)
    generator = np.random.default_rng(seed)
    written = [np.full(37, low)]
    for _ in range(6):
        what = generator.integers(3)
        if what == 0:
            request = legal_shape(generator, low, high, difference)
        elif what == 1:
            request = generator.uniform(-1.3, 1.3, 37)
            request[generator.integers(37)] = generator.choice([0.0, np.nan, np.inf, 1e300])
        else:
            request = np.full(37, 0.5 * (low + high))
        try:
            target = limiter.check_shape(request)
        except Refusal:
            continue
        if what == 2:
            path = limiter.path(written[-1], degauss_waypoints(37, 0.5 * (low + high), 0.5 * (high - low), 5, target))
        else:
            path = limiter.ramp(written[-1], target)
        for left, shape in zip(range(generator.integers(1, 60)), path, strict=False):
            del left
            limiter.check_write(written[-1], shape)
            written.append(shape)
    shapes = np.array(written)
    assert np.isfinite(shapes).all()
    assert shapes.min() >= low and shapes.max() <= high
    assert np.abs(shapes[:, A] - shapes[:, B]).max() <= difference + 2e-9
    if len(shapes) > 1:
        assert np.abs(np.diff(shapes, axis=0)).max() <= step + 1e-11


@settings(max_examples=30, deadline=None)
@given(limits, seeds)
def test_every_legal_request_is_reached(values: tuple[float, float, float, float], seed: int) -> None:
    low, high, difference, step = values
    limiter = make_limiter(low, high, difference, step)
    generator = np.random.default_rng(seed)
    start, target = (limiter.check_shape(legal_shape(generator, low, high, difference)) for _ in range(2))
    assert (list(limiter.ramp(start, target))[-1] == target).all()


@settings(max_examples=30)
@given(st.integers(1, 60), st.floats(0.01, 1.0), st.floats(-0.5, 0.5))
def test_degauss_alternates_and_decays_linearly(steps: int, amplitude: float, middle: float) -> None:
    end = np.full(37, 0.123)
    points = np.array(list(degauss_waypoints(37, middle, amplitude, steps, end)))
    assert (points == points[:, :1]).all()
    assert points.shape == (steps + 2, 37) and (points[-1] == end).all()
    swing = (points[:-1, 0] - middle) * np.where(np.arange(steps + 1) % 2, 1, -1)
    assert swing == pytest.approx(amplitude * (1 - np.arange(steps + 1) / steps), abs=1e-12)


def test_watchdog() -> None:
    watchdog = Watchdog(2.0)
    assert not watchdog.expired(1e9)
    watchdog.feed(10.0)
    assert not watchdog.expired(11.9)
    assert watchdog.expired(12.0)
    watchdog.disarm()
    assert not watchdog.expired(1e9)
    off = Watchdog(0.0)
    off.feed(10.0)
    assert not off.expired(1e9)
