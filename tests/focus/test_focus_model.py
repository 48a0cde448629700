"""Commands for curvatures on a linear mirror with known influence functions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from dm_msgs.msg import FocusRequest

from dm_common.errors import Refusal
from dm_common.limits import Limits
from dm_common.optics.zernike import basis
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.planning.target import REQUEST, FocusTarget, TargetError
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model

PAIRS = np.asarray(make_mirror().limits.pairs, dtype=np.intp)


@pytest.fixture(scope="module")
def mirror() -> LinearMirror:
    return LinearMirror(*hexagon())


def calibrated(mirror: LinearMirror, neighbour_difference: float = 2.0, held_out: float = 0.0) -> CalibratedMirror:
    return CalibratedMirror(perfect_model(mirror, held_out), Limits(-1.0, 1.0, PAIRS, neighbour_difference))


@pytest.mark.parametrize("curvature", [-0.03, 0.0, 0.01, 0.03])
def test_the_surface_takes_the_curvature(mirror: LinearMirror, curvature: float) -> None:
    """The true surface of the planned command, against the sphere by itself: c r^2 / 2 to third order."""
    plan = calibrated(mirror).plan(FocusTarget(curvature))
    sag = mirror.sag(plan.signals)
    radius = RADIUS * np.hypot(mirror.points.x, mirror.points.y)
    error = mirror.fit_terms(sag - curvature * radius**2 / 2)
    assert np.abs(error[3:]).max() < 1e-10
    assert plan.max_zernike < 1e-10
    assert not plan.saturated.any()


def test_the_others_do_not_follow_an_actuator_that_stands_at_an_end(mirror: LinearMirror) -> None:
    """Piston is free: where all went down to it, they stood where laws of hysteresis hold worst."""
    model, moves = perfect_model(mirror, 0.0), np.arange(37) != 4
    model = replace(
        model,
        influence_zernike=model.influence_zernike * moves,
        influence_sag=model.influence_sag * moves,
        zernike_offset=model.zernike_offset - model.influence_zernike[:, 4],
        sag_offset=model.sag_offset - model.influence_sag[:, 4],
    )
    plan = CalibratedMirror(model, Limits(-1.0, 1.0, PAIRS, 1.0)).plan(FocusTarget(0.0))
    assert plan.max_zernike < 1e-10
    assert abs(plan.signals.mean()) < 0.35


def test_predicted_rms_is_the_true_one(mirror: LinearMirror) -> None:
    target = FocusTarget(0.03, conic_constant=-1.0)
    plan = calibrated(mirror).plan(target)
    points = mirror.points
    error = mirror.sag(plan.signals) - target.sag(points.x, points.y, RADIUS)
    tilt_free = (
        error
        - np.column_stack([np.ones(len(points)), points.x, points.y])
        @ np.linalg.lstsq(
            np.sqrt(points.weight)[:, None] * np.column_stack([np.ones(len(points)), points.x, points.y]),
            np.sqrt(points.weight) * error,
            rcond=None,
        )[0]
    )
    assert plan.rms == pytest.approx(math.sqrt(points.weight @ tilt_free**2), rel=1e-6)


def test_bounds_hold_the_held_out_error(mirror: LinearMirror) -> None:
    plan = calibrated(mirror, held_out=5e-9).plan(FocusTarget(0.02))
    assert plan.rms_upper == pytest.approx(math.hypot(plan.rms, 1.96 * 5e-9))
    assert plan.max_zernike_upper == pytest.approx(plan.max_zernike + 5e-9)


def test_reachable_range_has_its_edge_where_the_error_meets_the_tolerance(mirror: LinearMirror) -> None:
    controller, tolerance = calibrated(mirror), 1e-8
    low, high = controller.reachable_range(FocusTarget(0.0), tolerance)
    assert low < 0 < high
    for edge in (low, high):
        assert controller.plan(FocusTarget(edge)).max_zernike <= tolerance
        assert controller.plan(FocusTarget(edge * 1.01)).max_zernike > tolerance
        assert controller.plan(FocusTarget(edge * 1.01)).saturated.any()


def test_the_range_of_a_mirror_that_does_not_reach_0(mirror: LinearMirror) -> None:
    """Pulled in mid range to a bowl deeper than its stroke can lift: the same range about another middle."""
    bowl = 0.2
    flat = calibrated(mirror)
    defocus = np.zeros_like(flat.model.zernike_offset)
    defocus[3] = bowl * RADIUS**2 / 4.0
    figure = flat.model.sag_offset + mirror.modes @ defocus
    pulled = replace(flat.model, zernike_offset=flat.model.zernike_offset + defocus, sag_offset=figure)
    low, high = flat.reachable_range(FocusTarget(0.0), 1e-8)
    assert CalibratedMirror(pulled, flat.limits).reachable_range(FocusTarget(0.0), 1e-8) == pytest.approx(
        (bowl + low, bowl + high), abs=1e-4
    )


def test_a_tighter_neighbour_limit_narrows_the_range_and_is_kept(mirror: LinearMirror) -> None:
    wide, narrow = calibrated(mirror), calibrated(mirror, neighbour_difference=0.15)
    assert narrow.reachable_range(FocusTarget(0.0), 1e-8)[1] < wide.reachable_range(FocusTarget(0.0), 1e-8)[1]
    plan = narrow.plan(FocusTarget(0.05))
    differences = np.abs(plan.signals[PAIRS[:, 0]] - plan.signals[PAIRS[:, 1]])
    assert differences.max() <= 0.15 + 1e-9


def test_added_terms_appear_on_the_surface(mirror: LinearMirror) -> None:
    wanted = np.zeros(21)
    wanted[4], wanted[6] = 3e-7, -1e-7
    plan = calibrated(mirror).plan(FocusTarget(0.01, zernike=tuple(wanted)))
    radius = RADIUS * np.hypot(mirror.points.x, mirror.points.y)
    surface = mirror.fit_terms(mirror.sag(plan.signals) - 0.01 * radius**2 / 2)
    np.testing.assert_allclose(surface[3:], wanted[3:], atol=1e-10)


def test_nothing_is_reachable_with_terms_beyond_the_stroke(mirror: LinearMirror) -> None:
    wanted = np.zeros(21)
    wanted[10] = 1e-3
    low, high = calibrated(mirror).reachable_range(FocusTarget(0.0, zernike=tuple(wanted)), 1e-8)
    assert math.isnan(low)
    assert math.isnan(high)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"curvature": math.nan}, "curvature = nan"),
        ({"curvature": 0.0, "conic_constant": math.inf}, "conic_constant = inf"),
        ({"curvature": 0.0, "zernike": (0.0, 1.0)}, "zernike has 2 values: must have 0 or 21"),
        ({"curvature": 0.0, "zernike": (math.nan,) * 21}, r"zernike\[0\] = nan: must be float\[\], -1 to 1 m"),
    ],
)
def test_impossible_requests_are_refused_by_name(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(Refusal, match=words):
        REQUEST.check(FocusRequest(**arguments))


def test_a_sphere_smaller_than_the_aperture_is_refused() -> None:
    with pytest.raises(TargetError, match="must be below 1"):
        FocusTarget(200.0).coefficients(RADIUS)


def test_sag_and_coefficients_agree() -> None:
    target = FocusTarget(0.05, -0.5)
    x, y = np.array([0.0, 0.3, -0.6]), np.array([0.1, -0.2, 0.7])
    np.testing.assert_allclose(target.sag(x, y, RADIUS), basis(x, y) @ target.coefficients(RADIUS), atol=1e-15)


def test_inconsistent_calibrations_are_refused(mirror: LinearMirror) -> None:
    good = perfect_model(mirror, 0.0)
    fields = {name: getattr(good, name) for name in good.__dataclass_fields__}
    with pytest.raises(ValueError, match="sag_offset has the shape"):
        InfluenceModel(**{**fields, "sag_offset": np.zeros(3)})
    with pytest.raises(ValueError, match="influence_sag holds values that are not finite"):
        InfluenceModel(**{**fields, "influence_sag": np.full_like(mirror.influence, np.nan)})


@pytest.mark.parametrize("moving", [1, 3, 18])
def test_a_mirror_most_of_which_does_nothing_still_focuses(mirror: LinearMirror, moving: int) -> None:
    model, moves = perfect_model(mirror, 0.0), np.arange(37) < moving
    model = replace(model, influence_zernike=model.influence_zernike * moves, influence_sag=model.influence_sag * moves)
    plan = CalibratedMirror(model, Limits(-1.0, 1.0, PAIRS, 2.0)).plan(FocusTarget(0.001))
    assert np.isfinite(plan.max_zernike) and not plan.signals[~moves].any() and plan.signals[moves].any()


@pytest.mark.parametrize("terms", [0, 1, 20])
def test_another_number_of_terms_is_refused_by_name(mirror: LinearMirror, terms: int) -> None:
    model = perfect_model(mirror, 0.0)
    with pytest.raises(ValueError, match=rf"influence_zernike has the shape \({terms}, 37\): must be \(21, 37\)"):
        replace(model, influence_zernike=model.influence_zernike[:terms], zernike_offset=model.zernike_offset[:terms])
