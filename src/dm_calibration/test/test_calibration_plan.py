"""The order in which a calibration measures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.excitation import REPEATS
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.surfaces import MODEL_NAMES, TABLE_1
from dm_calibration.procedure.plan import PlanKind, PlanOptions, StepKind, make_plan, shape_in_use
from dm_common.errors import UnknownNameError
from linear_mirror import make_mirror
from steady_mirror import SteadyMirror


def test_full_plan_has_pokes_then_surfaces_then_solved_shapes() -> None:
    plan = make_plan(PlanKind.FULL, make_mirror())
    assert plan.steps[0].kind is StepKind.DEGAUSS
    assert plan.steps[1].kind is plan.steps[-1].kind is StepKind.REFERENCE
    states = [step for step in plan.steps if step.kind in (StepKind.POKE, StepKind.SURFACE)]
    assert len(states) == 2 * 37 + 69
    assert [step.label for step in states[74:]] == list(TABLE_1)
    assert [step.label for step in states if step.needs_model] == list(MODEL_NAMES)
    assert len({step.label for step in plan.steps}) == len(plan.steps)
    assert plan.remarks == ()


def test_reference_frames_come_every_so_many_steps() -> None:
    plan = make_plan(PlanKind.POKES, make_mirror(), PlanOptions(reference_every=7, degauss=False))
    kinds = [step.kind for step in plan.steps]
    gaps = np.diff(np.flatnonzero([kind is StepKind.REFERENCE for kind in kinds])) - 1
    assert kinds[0] is StepKind.REFERENCE
    assert (gaps[:-1] == 7).all() and 0 < gaps[-1] <= 7
    for step in plan.steps:
        if step.kind is StepKind.REFERENCE:
            assert step.signals is not None and (step.signals == 0.0).all()


def test_pokes_push_and_pull_one_actuator() -> None:
    pokes = [s for s in make_plan(PlanKind.POKE_CHECK, make_mirror()).steps if s.kind is StepKind.POKE]
    for k in range(37):
        unit = np.eye(37)[k]
        assert pokes[2 * k].label == f"poke+{k + 1:02d}"
        for step, expected in ((pokes[2 * k], 0.5 * unit), (pokes[2 * k + 1], -0.5 * unit)):
            assert step.signals is not None and np.array_equal(step.signals, expected)


def test_pokes_shrink_to_the_neighbour_limit() -> None:
    plan = make_plan(PlanKind.POKES, make_mirror(neighbour_difference_max=0.2))
    poke = next(step for step in plan.steps if step.kind is StepKind.POKE)
    assert poke.signals is not None
    assert poke.signals[0] == pytest.approx(0.2) and poke.signals[0] <= 0.2
    assert (poke.signals[1:] == 0.0).all()
    assert "pokes reduced to 40%" in plan.remarks[0]


def test_chosen_surfaces_only() -> None:
    plan = make_plan(PlanKind.SURFACES, make_mirror(), PlanOptions(surfaces=("p55", "p03")))
    assert [step.label for step in plan.steps if step.kind is StepKind.SURFACE] == ["p03", "p55"]
    assert any(step.needs_model for step in plan.steps)
    with pytest.raises(UnknownNameError, match="did you mean"):
        make_plan(PlanKind.SURFACES, make_mirror(), PlanOptions(surfaces=("p59",)))


@pytest.mark.parametrize("kind", [PlanKind.HYSTERESIS, PlanKind.POKES, PlanKind.POKE_CHECK])
def test_surfaces_of_a_plan_without_any_are_refused(kind: PlanKind) -> None:
    with pytest.raises(ValueError, match=rf"surfaces = p06, p07: the plan {kind.name.lower()} measures none of them"):
        make_plan(kind, make_mirror(), PlanOptions(surfaces=("p06", "p07")))
    with pytest.raises(UnknownNameError):
        make_plan(kind, make_mirror(), PlanOptions(surfaces=("nonsense",)))


def test_a_small_mirror_leaves_surfaces_out_or_refuses_them_by_name() -> None:
    small = make_mirror(rings=2)
    plan = make_plan(PlanKind.SURFACES, small)
    assert any("p25 moves actuator 20" in remark for remark in plan.remarks)
    with pytest.raises(ValueError, match="p25 moves actuator 20"):
        make_plan(PlanKind.SURFACES, small, PlanOptions(surfaces=("p25",)))


def test_a_run_too_short_for_so_many_actuators_is_refused_before_it_moves() -> None:
    with pytest.raises(TooFewMapsError, match="hysteresis_maps = 73: must be 74 to 2000 for 37 actuators"):
        make_plan(PlanKind.HYSTERESIS, make_mirror(), PlanOptions(hysteresis_maps=73))


def test_moves_in_use_follow_a_degauss_with_a_map_at_rest() -> None:
    """Each part of a run begins its checks so, and those of many checks have another halfway."""
    plan = make_plan(PlanKind.HYSTERESIS, make_mirror(rings=1), PlanOptions(hysteresis_maps=200, until=2e-9))
    kinds = [step.kind for step in plan.steps]
    degausses = [number for number, kind in enumerate(kinds) if kind is StepKind.DEGAUSS][1:]
    assert len(degausses) == len(plan.ends) + 1
    whole = make_plan(PlanKind.HYSTERESIS, make_mirror(rings=1)).steps
    assert [step.label for step in whole if step.kind is StepKind.DEGAUSSED] == ["degaussed 240", "degaussed 270"]
    for number in degausses:
        at_rest = plan.steps[number + 1]
        assert at_rest.kind is StepKind.DEGAUSSED and at_rest.signals is not None and not at_rest.signals.any()
        assert kinds[number + 2] is StepKind.CHECK
    assert len({step.label for step in plan.steps}) == len(plan.steps)


@pytest.mark.parametrize("kind", [StepKind.CHECK, StepKind.IN_USE])
def test_shapes_as_in_use_lie_where_the_mirror_is_used(kind: StepKind) -> None:
    """About the shape that flattens it; all over the range of one that is flat at an end of it, as a membrane."""
    bench = SteadyMirror()
    fit = bench.calibrate().fit
    pulled = replace(fit, sag_offset=-fit.influence_sag @ np.full(fit.actuators, -0.9))
    plan = make_plan(PlanKind.HYSTERESIS, bench.mirror, PlanOptions(hysteresis_maps=150))
    steps = [step for step in plan.steps if step.kind is kind]
    levels = {}
    for name, model in (("two-sided", fit), ("one-sided", pulled)):
        shapes = [shape_in_use(step, model, bench.mirror).signals for step in steps]
        levels[name] = np.array([shape.mean() for shape in shapes if shape is not None])
        assert all(shape is not None and bench.mirror.limits.allow(shape) for shape in shapes)
    assert np.allclose(
        levels["two-sided"], [step.signals.mean() for step in steps if step.signals is not None], atol=0.1
    )
    assert levels["one-sided"].min() < -0.7 and levels["one-sided"].max() > 0.7
    assert abs(levels["one-sided"].mean()) < 0.25


@pytest.mark.parametrize(
    ("rings", "most", "looks"), [(3, 420, [80, 100, 120, 160, 200, 240, 300, 380]), (1, 100, [60, 80]), (3, 74, [])]
)
def test_a_run_that_may_end_early_asks_as_soon_as_a_law_can_be_found(rings: int, most: int, looks: list[int]) -> None:
    """60 commands do for a small mirror; 37 actuators need two for each. Later it asks after a quarter more."""
    plan = make_plan(PlanKind.HYSTERESIS, make_mirror(rings=rings), PlanOptions(hysteresis_maps=most, until=2e-9))
    commands = [
        sum(step.in_use or step.kind is StepKind.EXCITATION for step in plan.steps[:end]) - REPEATS
        for end in sorted(plan.ends)
    ]
    assert commands == looks
    for end in sorted(plan.ends):
        assert plan.steps[end - 1].kind in (StepKind.CHECK, StepKind.REFERENCE)


def test_pokes_that_are_reduced_by_rounding_only_are_not_told() -> None:
    mirror = make_mirror()
    narrow = replace(mirror, limits=replace(mirror.limits, low=0.1, high=0.7))
    assert make_plan(PlanKind.POKES, narrow, PlanOptions(poke_amplitude=1.0)).remarks == ()
