"""Plans by the closed form are those of the solver that knows the limits."""

from __future__ import annotations

import numpy as np
import pytest

from dm_common.limits import Limits
from dm_common.optics.zernike import TERMS
from dm_controller.planning.mirror_model import CalibratedMirror, Plan
from dm_controller.planning.target import FocusTarget
from linear_mirror import LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model


@pytest.fixture(scope="module")
def mirror() -> CalibratedMirror:
    limits = Limits(-1.0, 1.0, np.array(make_mirror().limits.pairs), 2.0)
    return CalibratedMirror(perfect_model(LinearMirror(*hexagon())), limits)


def solved(mirror: CalibratedMirror, target: FocusTarget) -> Plan:
    """The plan by the bounded programme, whatever its limits."""
    return mirror.predict(target, mirror.solve_target(target)[0])


@pytest.mark.parametrize("curvature", [-0.05, 0.0, 0.02])
@pytest.mark.parametrize("conic_constant", [0.0, -1.0, 4.0])
@pytest.mark.parametrize("added", [0.0, 2e-8])
def test_both_ways_agree(mirror: CalibratedMirror, curvature: float, conic_constant: float, added: float) -> None:
    terms = added * np.random.default_rng(1).normal(size=len(TERMS))
    target = FocusTarget(curvature, conic_constant, tuple(terms) if added else ())
    plan, expected = mirror.plan(target), solved(mirror, target)
    assert mirror.command(target)[1] == pytest.approx(plan.max_zernike, abs=1e-14)
    np.testing.assert_allclose(plan.signals, expected.signals, atol=1e-9)
    assert plan.rms == pytest.approx(expected.rms, abs=1e-14)
    assert plan.max_zernike == pytest.approx(expected.max_zernike, abs=1e-14)


def test_limits_are_kept(mirror: CalibratedMirror) -> None:
    plan = mirror.plan(FocusTarget(0.3))
    assert plan.saturated.any()
    assert np.abs(plan.signals).max() <= 1.0


def test_a_deep_conic_is_told_by_its_exact_sag(mirror: CalibratedMirror) -> None:
    target = FocusTarget(5.0)
    assert mirror.plan(target).rms == pytest.approx(solved(mirror, target).rms, rel=1e-9)
