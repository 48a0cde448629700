"""The bounded programme against optimality conditions, a general-purpose solver and clipping."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from dm_common.bounded import BoundedProgramme
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_common.limits import SLACK, Limits
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import basis

NO_PAIRS = np.zeros((0, 2), dtype=np.intp)


def chain(count: int) -> np.ndarray[Any, Any]:
    return np.column_stack([np.arange(count - 1), np.arange(1, count)])


def test_inside_the_limits_it_is_least_squares() -> None:
    generator = np.random.default_rng(1)
    matrix = generator.normal(size=(40, 8))
    wanted = matrix @ generator.uniform(-0.5, 0.5, 8) + 1e-3 * generator.normal(size=40)
    solved = BoundedProgramme(matrix, Limits(-1, 1, NO_PAIRS, 2.0)).solve(wanted)
    np.testing.assert_allclose(solved, np.linalg.lstsq(matrix, wanted, rcond=None)[0], atol=1e-12)


def test_metres_and_nanometres_give_the_same_signals() -> None:
    generator = np.random.default_rng(2)
    matrix, wanted = generator.normal(size=(30, 6)), 3 * generator.normal(size=30)
    limits = Limits(-1, 1, chain(6), 0.5)
    metres = BoundedProgramme(1e-9 * matrix, limits, 1e-21).solve(1e-9 * wanted)
    np.testing.assert_allclose(metres, BoundedProgramme(matrix, limits, 1e-3).solve(wanted), atol=1e-8)


@pytest.mark.parametrize("demand", [1e4, 1e6, 1e8])
def test_wishes_far_beyond_reach_are_met_as_far_as_that_goes(demand: float) -> None:
    """A wish so far away only counts by its direction: the signals are those that go furthest along it."""
    generator = np.random.default_rng(3)
    matrix, wanted = generator.normal(size=(30, 6)), demand * generator.normal(size=30)
    limits = Limits(-1, 1, chain(6), 0.5)
    signals = BoundedProgramme(matrix, limits).solve(wanted)
    assert limits.allow(signals)
    differences = np.diff(np.eye(6), axis=0)
    along = wanted @ matrix
    furthest = linprog(-along, np.vstack((differences, -differences)), np.full(10, 0.5), bounds=(-1, 1)).x
    assert along @ signals >= along @ furthest * (1.0 - 10.0 / demand)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), demand=st.floats(0.1, 20.0), difference=st.floats(0.05, 2.5))
def test_result_is_feasible_and_optimal(seed: int, demand: float, difference: float) -> None:
    """No feasible direction improves: compare with many feasible points and a general solver's answer."""
    generator = np.random.default_rng(seed)
    matrix, wanted = generator.normal(size=(14, 6)), demand * generator.normal(size=14)
    limits = Limits(-1.0, 1.0, chain(6), difference)
    signals = BoundedProgramme(matrix, limits).solve(wanted)
    assert limits.allow(signals)

    def cost(s: np.ndarray[Any, Any]) -> float:
        return float(np.sum((matrix @ s - wanted) ** 2))

    constraints = [
        {"type": "ineq", "fun": lambda s: difference - (s[:-1] - s[1:])},
        {"type": "ineq", "fun": lambda s: difference + (s[:-1] - s[1:])},
    ]
    other = minimize(cost, np.zeros(6), method="SLSQP", bounds=[(-1, 1)] * 6, constraints=constraints, tol=1e-12)
    # The general solver may stop outside the limits.
    assert cost(signals) <= cost(limits.scaled(other.x)[0]) * (1 + 1e-6) + 1e-6


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), demand=st.floats(0.5, 5.0), spread=st.floats(1.0, 4.5))
def test_optimality_conditions_hold_for_ill_conditioned_mirrors(seed: int, demand: float, spread: float) -> None:
    """37 signals, condition numbers up to 3e4: at the optimum the gradient vanishes, or pushes outwards at a limit."""
    generator = np.random.default_rng(seed)
    left, right = (np.linalg.qr(generator.normal(size=(60, 37)))[0], np.linalg.qr(generator.normal(size=(37, 37)))[0])
    matrix = left * np.logspace(0, -spread, 37) @ right
    # A part that the signals cannot make, as print-through; unconstrained it asks for signals some times the range.
    wanted = matrix @ (demand * generator.normal(size=37)) + 10.0**-spread * generator.normal(size=60)
    signals = BoundedProgramme(matrix, Limits(-1.0, 1.0, NO_PAIRS, 2.0)).solve(wanted)
    gradient = matrix.T @ (matrix @ signals - wanted)
    scale = np.abs(matrix.T @ wanted).max()
    free = np.abs(signals) < 1.0 - 1e-9
    assert np.abs(gradient[free]).max(initial=0.0) < 1e-7 * scale
    assert (gradient[~free] * np.sign(signals[~free])).max(initial=0.0) < 1e-7 * scale


def test_it_beats_clipping_when_saturated() -> None:
    # Overlapping bumps on a line, asked for a parabola that is too deep for them.
    points, centres = np.linspace(-1, 1, 80), np.linspace(-1.1, 1.1, 12)
    matrix = np.exp(-(((points[:, None] - centres) / 0.25) ** 2))
    wanted = 3.0 * points**2
    limits = Limits(-1, 1, NO_PAIRS, 2.0)
    signals = BoundedProgramme(matrix, limits).solve(wanted)
    clipped = np.clip(np.linalg.lstsq(matrix, wanted, rcond=None)[0], -1, 1)
    assert np.linalg.norm(matrix @ signals - wanted) < 0.9 * np.linalg.norm(matrix @ clipped - wanted)
    assert limits.at_limit(signals).any()


def test_neighbours_at_their_limit_are_marked() -> None:
    programme = BoundedProgramme(np.eye(3), Limits(-1, 1, chain(3), 0.4))
    signals = programme.solve([0.9, -0.9, -0.5])
    assert abs(signals[0] - signals[1]) == pytest.approx(0.4)
    assert programme.limits.at_limit(signals).tolist() == [True, True, False]


def test_unreached_actuator_needs_a_ridge() -> None:
    matrix = np.eye(3)[:, [0, 1, 1]] * [1.0, 1.0, 0.0]
    with pytest.raises(ValueError, match="ridge"):
        BoundedProgramme(matrix, Limits(-1, 1, NO_PAIRS, 2.0))
    assert BoundedProgramme(matrix, Limits(-1, 1, NO_PAIRS, 2.0), ridge=1e-6).solve([0.5, 0.5, 0])[2] == pytest.approx(
        0
    )


@pytest.mark.parametrize("wanted", [[1.0], [1.0, np.nan, 0.0], [1.0, 2.0, np.inf]])
def test_bad_right_hand_sides_are_refused(wanted: list[float]) -> None:
    with pytest.raises(ValueError, match="must be 3 finite numbers"):
        BoundedProgramme(np.eye(3), Limits(-1, 1, NO_PAIRS, 2.0)).solve(wanted)


@settings(max_examples=30, deadline=None)
@given(curvature=st.floats(-0.4, 0.4), difference=st.floats(0.3, 2.0))
def test_spheres_keep_the_limit_between_neighbours(curvature: float, difference: float) -> None:
    """To the rounding that the driver allows, on the ill-conditioned influence of a plate."""
    x, y = hexagonal_positions(37)
    radius, points = 11e-3, edge_clustered_points(300)
    away = np.hypot(points.x[:, None] * radius - x, points.y[:, None] * radius - y)
    modes = basis(points.x, points.y)
    influence = 4e-6 * np.exp(-((away / 5e-3) ** 2))
    terms = np.linalg.lstsq(modes, influence, rcond=None)[0][3:]
    sag = influence - modes[:, :3] @ np.linalg.lstsq(modes[:, :3], influence, rcond=None)[0]
    matrix = np.vstack([100.0 * terms, sag / np.sqrt(len(sag))])
    sphere = np.zeros(18)
    sphere[0] = 0.25 * curvature * radius**2
    wanted = np.concatenate([100.0 * sphere, modes[:, 3] * sphere[0] / np.sqrt(len(sag))])
    limits = Limits(-1.0, 1.0, neighbour_pairs(x, y), difference)
    ridge = 1e-8 * float(np.square(matrix).sum(axis=0).mean())
    signals = BoundedProgramme(matrix, limits, ridge).solve(wanted)
    assert np.abs(signals).max() <= 1.0
    assert limits.differences(signals).max() <= difference + SLACK
