"""Positions of the actuators, which of them are neighbours, and their rings."""

from __future__ import annotations

import math
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common import geometry
from dm_common.geometry import hexagonal_positions, neighbour_pairs, pitch, ring_count, rings


def test_pdm30_37_pattern() -> None:
    x, y = hexagonal_positions(37, 4.3e-3)
    radius, angle = np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 360
    assert radius[0] == 0
    assert radius[1:7] == pytest.approx(4.3e-3)
    assert sorted(set(np.round(radius[7:19] * 1e3, 3))) == [round(4.3 * math.sqrt(3), 3), 8.6]
    assert radius[[19, 22, 25, 28, 31, 34]] == pytest.approx(12.9e-3)
    assert radius.max() == pytest.approx(12.9e-3)
    for ring in (slice(1, 7), slice(7, 19), slice(19, 37)):
        assert (np.diff(angle[ring]) > 0).all()
        assert angle[ring][0] == pytest.approx(0)
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    assert distance[np.triu_indices(37, 1)].min() == pytest.approx(4.3e-3)


@settings(max_examples=20)
@given(st.floats(-3, 3), st.booleans(), st.booleans())
def test_orientation_of_the_pattern(start_angle: float, clockwise: bool, reflected: bool) -> None:
    x, y = hexagonal_positions(37, 4.3e-3, start_angle, clockwise, reflected)
    sign_x = -1 if reflected else 1
    for first in (1, 7, 19):
        angle = math.atan2(y[first], sign_x * x[first])
        assert math.remainder(angle - start_angle, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    turn = x[1] * y[2] - y[1] * x[2]
    assert (turn > 0) == (clockwise == reflected)
    plain_x, plain_y = hexagonal_positions(37, 4.3e-3)
    assert np.hypot(x, y) == pytest.approx(np.hypot(plain_x, plain_y), abs=1e-12)


def test_neighbours_of_the_pattern() -> None:
    x, y = hexagonal_positions(37, 4.3e-3, start_angle=0.3)
    a, b = neighbour_pairs(x, y).T
    assert len(a) == 90  # edges of a triangular lattice hexagon of side 3: 9 s^2 + 3 s
    assert (a < b).all()
    counts = np.bincount(np.concatenate([a, b]), minlength=37)
    assert (counts[:19] == 6).all()
    assert sorted(counts[19:]) == [3] * 6 + [4] * 12
    assert set(zip(a[a == 0], b[a == 0], strict=True)) == {(0, k) for k in range(1, 7)}


def ring_positions(*numbers: int) -> tuple[np.ndarray, np.ndarray]:
    """Patches in rings around a central one, 4.2 mm from ring to ring."""
    radius = np.repeat(4.2e-3 * np.arange(len(numbers) + 1), (1, *numbers))
    angle = np.concatenate([np.arange(number) * 2.0 * math.pi / number for number in (1, *numbers)])
    return radius * np.cos(angle), radius * np.sin(angle)


def square_positions(side: int, pitch_m: float = 4.6e-3) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(pitch_m * np.arange(side), pitch_m * np.arange(side))
    return x.ravel(), y.ravel()


def close_pairs(x: np.ndarray, y: np.ndarray) -> list[list[int]]:
    """Pairs closer than 1.2 times the smallest distance: the neighbours on a grid."""
    first, second = np.triu_indices(x.size, k=1)
    apart = np.hypot(x[first] - x[second], y[first] - y[second])
    return np.column_stack((first, second))[apart < 1.2 * apart.min(initial=np.inf)].tolist()


@pytest.mark.parametrize(
    ("x", "y"),
    [
        *(hexagonal_positions(actuators, 4.3e-3, 0.3, clockwise=True) for actuators in (1, 7, 19, 37, 61, 127)),
        np.round(hexagonal_positions(37, 4.3e-3, 0.3), 4),
        *(square_positions(side) for side in (1, 2, 3, 6, 12)),
        np.round(square_positions(6, 4.63e-3), 4),
        np.array(square_positions(6))[:, np.setdiff1d(np.arange(36), [0, 5, 30, 35, 14])],  # no corners, a hole
    ],
)
def test_neighbours_on_a_grid_are_the_nearest(x: np.ndarray, y: np.ndarray) -> None:
    assert neighbour_pairs(x, y).tolist() == close_pairs(x, y)


def test_patches_in_rings_have_neighbours_within_and_between_rings() -> None:
    """By a multiple of the smallest distance, the sixteen patches of the outer ring had none."""
    x, y = ring_positions(6, 12, 16)
    pairs = {tuple(pair) for pair in neighbour_pairs(x, y).tolist()}
    assert {(0, number) for number in range(1, 7)} <= pairs
    for first, number in ((1, 6), (7, 12), (19, 16)):
        ring = [(first + step, first + (step + 1) % number) for step in range(number)]
        assert {(min(pair), max(pair)) for pair in ring} <= pairs
    outer = [sum(7 <= a < 19 for a, b in pairs if b == patch) for patch in range(19, 35)]
    assert min(outer) >= 1 and max(outer) <= 2
    assert rings(x, y).tolist() == [0] + [1] * 6 + [2] * 12 + [3] * 16


@pytest.mark.parametrize(
    ("x", "pairs"),
    [
        ([0.0], []),
        ([1.0, 0.0], [[0, 1]]),
        ([0.0, 1.0, 3.0, 3.5, 9.0], [[0, 1], [1, 2], [2, 3], [3, 4]]),
        ([2.0, 0.0, 1.0], [[0, 2], [1, 2]]),
    ],
)
def test_neighbours_on_a_line(x: list[float], pairs: list[list[int]]) -> None:
    for turn in (0.0, 0.7):
        assert neighbour_pairs(math.cos(turn) * np.array(x), math.sin(turn) * np.array(x)).tolist() == pairs


def test_neighbours_in_rows_of_unequal_distance() -> None:
    x, y = np.meshgrid([0.0, 1.0, 2.0, 3.0], [0.0, 3.0, 8.0])
    a, b = np.array(neighbour_pairs(x.ravel(), y.ravel())).T
    assert len(a) == 3 * 3 + 2 * 4  # along the rows and across, but no diagonal
    assert set(b - a) == {1, 4}


@settings(max_examples=50, deadline=None)
@given(st.integers(2, 40), st.integers(0, 10**6), st.booleans())
def test_neighbours_of_any_arrangement(actuators: int, seed: int, clustered: bool) -> None:
    x, y = np.random.default_rng(seed).standard_normal((2, actuators)) ** (3 if clustered else 1)
    pairs = neighbour_pairs(x, y)
    assert {tuple(pair) for pair in close_pairs(x, y)} <= {tuple(pair) for pair in pairs}
    assert (rings(x, y) >= 0).all(), "a chain of neighbours reaches every actuator"
    square = np.square(x[:, None] - x) + np.square(y[:, None] - y)
    legs = square[:, :, None] + square  # [i, k, j]: squares of the distances of k from i and j
    ratio = legs / np.where(np.eye(actuators, dtype=bool), 1.0, square)[:, None, :]
    own = np.arange(actuators)
    ratio[own, own, :] = ratio[:, own, own] = np.inf
    least = ratio.min(axis=1)[np.triu_indices(actuators, 1)]
    near = np.zeros((actuators, actuators), dtype=bool)
    near[tuple(pairs.T)] = True
    found = near[np.triu_indices(actuators, 1)]
    assert (least[found] > 1.0).all() and (least[~found] < 1.06).all()


def test_neighbours_of_an_actuator_within_a_ring_of_thousands(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that asked every actuator nearer than the centre, one by one, needed a minute and more."""
    angle, asked = np.arange(2000) * 2.0 * math.pi / 2000, Mock(wraps=geometry._between)
    monkeypatch.setattr(geometry, "_between", asked)
    pairs = neighbour_pairs(np.append(np.cos(angle), 0.0), np.append(np.sin(angle), 0.0))
    assert asked.call_count < 10 * 2001, "an array at a time"
    assert np.bincount(pairs.ravel()).tolist() == [3] * 2000 + [2000]


def test_two_actuators_at_one_place_are_refused() -> None:
    with pytest.raises(ValueError, match="actuators 1 and 3 are at the same place"):
        neighbour_pairs(np.array([0.0, 1.0, 0.0]), np.zeros(3))


@pytest.mark.parametrize(("actuators", "rings"), [(1, 0), (7, 1), (19, 2), (37, 3), (61, 4)])
def test_full_patterns(actuators: int, rings: int) -> None:
    assert ring_count(actuators) == rings
    assert hexagonal_positions(actuators)[0].size == actuators


@pytest.mark.parametrize("actuators", [0, 2, 36, 38])
def test_other_numbers_have_no_pattern(actuators: int) -> None:
    with pytest.raises(ValueError, match=f"mirror.actuators = {actuators}"):
        ring_count(actuators)


def test_rings_come_from_positions() -> None:
    assert rings(*hexagonal_positions(37)).tolist() == [0] + [1] * 6 + [2] * 12 + [3] * 18
    shuffled = np.random.default_rng(0).permutation(37)
    x, y = hexagonal_positions(37)
    assert (rings(x[shuffled], y[shuffled]) == rings(x, y)[shuffled]).all()
    assert rings(np.zeros(1), np.zeros(1)).tolist() == [0]
    assert rings(np.array([0.0, 1.0, -1.0, 9.0]), np.zeros(4)).max() >= 1


def test_pitch_is_the_smallest_distance() -> None:
    assert pitch(*hexagonal_positions(19, 3e-3)) == pytest.approx(3e-3)
