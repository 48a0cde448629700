"""What the closed form finds is what the solver that knows the limits finds, or it is left to that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_common.limits import Limits
from dm_common.optics.zernike import TERMS
from dm_controller.planning.fast_path import ClosedForm
from dm_controller.planning.mirror_model import CalibratedMirror, Plan
from dm_controller.planning.planner import Planner
from dm_controller.planning.target import FocusTarget, Shape
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model


@pytest.fixture(scope="module")
def mirror() -> CalibratedMirror:
    limits = Limits(-1.0, 1.0, np.array(make_mirror().limits.pairs), 2.0)
    plant = LinearMirror(*hexagon())
    model = replace(perfect_model(plant), actuator_x=RADIUS * plant.x, actuator_y=RADIUS * plant.y)
    return CalibratedMirror(model, limits, axis=(1e-4, -2e-4))


def solved(mirror: CalibratedMirror, target: FocusTarget) -> Plan:
    """The bounded programme for the exact surface less the figure, whatever `plan` and `command` make of it."""
    model = mirror.model
    coefficients = target.coefficients(model.aperture_radius) - model.zernike_offset
    sag = target.sag(model.points.x, model.points.y, model.aperture_radius) - model.sag_offset
    tilt = np.array(target.zernike[1:3] or (0.0, 0.0)) - target.curvature * model.aperture_radius * mirror.axis
    return mirror.predict(target, mirror.solve(mirror.rows(Shape(coefficients, sag), tilt)))


@pytest.mark.parametrize("curvature", [-0.05, 0.0, 0.02])
@pytest.mark.parametrize("conic_constant", [0.0, -1.0, 4.0])
@pytest.mark.parametrize("added", [0.0, 2e-8])
def test_both_ways_agree(mirror: CalibratedMirror, curvature: float, conic_constant: float, added: float) -> None:
    terms = added * np.random.default_rng(1).normal(size=len(TERMS))
    target = FocusTarget(curvature, conic_constant, tuple(terms) if added else ())
    found = ClosedForm(mirror).find(target)
    assert found is not None
    signals, largest = found
    plan, expected = mirror.predict(target, signals), solved(mirror, target)
    assert largest == pytest.approx(plan.max_zernike, abs=1e-14)
    np.testing.assert_allclose(signals, expected.signals, atol=1e-9)
    assert plan.rms == pytest.approx(expected.rms, abs=1e-14)
    assert plan.max_zernike == pytest.approx(expected.max_zernike, abs=1e-14)


def test_limits_are_kept(mirror: CalibratedMirror) -> None:
    target = FocusTarget(0.3)
    assert ClosedForm(mirror).find(target) is None
    plan = Planner(mirror).plan(target, None, 0.0).plan
    np.testing.assert_allclose(plan.signals, solved(mirror, target).signals, atol=1e-9)
    assert plan.saturated.any()
    assert np.abs(plan.signals).max() <= 1.0


def test_a_deep_conic_is_left_to_its_exact_sag(mirror: CalibratedMirror) -> None:
    target = FocusTarget(5.0)
    assert ClosedForm(mirror).find(target) is None
    assert Planner(mirror).plan(target, None, 0.0).plan.rms == pytest.approx(solved(mirror, target).rms, rel=1e-12)
