"""The procedure on a bench without ROS: retries, drops, cancelling, failures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.bump_check import BumpCheck, BumpOptions
from dm_calibration.procedure.outcome import Doubted, Dropped, MapTaken, Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, StepKind, make_plan
from dm_calibration.procedure.procedure import Procedure, ProcedureOptions, Progress
from dm_common.errors import Cancelled, Refusal
from dm_common.mirror import Mirror
from linear_bench import LinearBench
from linear_mirror import LinearMirror, make_mirror


@pytest.fixture
def mirror() -> Mirror:
    return make_mirror(rings=1)


@pytest.fixture
def bench(mirror: Mirror) -> LinearBench:
    return LinearBench(mirror)


def run(
    bench: LinearBench,
    mirror: Mirror,
    kind: PlanKind = PlanKind.POKES,
    plan_options: PlanOptions | None = None,
    **options: object,
) -> Procedure:
    plan = make_plan(kind, mirror, plan_options)
    procedure = Procedure(
        plan,
        mirror,
        bench,
        ProcedureOptions(**options),  # type: ignore[arg-type]
        cancelled=lambda: bench.stopped,
    )
    procedure.run()
    return procedure


def test_all_steps_are_measured_in_order(bench: LinearBench, mirror: Mirror) -> None:
    outcome = run(bench, mirror).outcome
    plan = make_plan(PlanKind.POKES, mirror)
    assert [move.degauss for move in bench.moves].count(True) == 1
    assert [record.label for record in outcome.records] == [step.label for step in plan.steps[1:]]
    assert outcome.dropped == []
    assert outcome.setup is not None and outcome.setup.wavelength == 632.8e-9
    record = outcome.records[1]
    assert (record.label, record.kind, record.file) == ("poke+01", "poke", "poke+01.dat")
    assert record.signals[0] == 0.5
    assert record.applied == pytest.approx(bench.applied[1])
    assert record.stamp_ns == bench.maps[1].stamp_ns == round(2.5e9)


def test_degausses_in_the_course_of_a_run_begin_no_new_one(bench: LinearBench, mirror: Mirror) -> None:
    """Where a map after one fails the history knows of it all the same, as of a reference frame in between; one that
    was interrupted is made again.
    """
    bench.failing = {"degaussed 240": 9, "reference 2": 9}
    plan = make_plan(PlanKind.HYSTERESIS, mirror)
    outcome = run(bench, mirror, PlanKind.HYSTERESIS).outcome
    assert [move.degauss for move in bench.moves].count(True) == 3
    maps = outcome.maps()
    assert maps.label == tuple(step.label for step in plan.steps if step.kind is not StepKind.DEGAUSS)
    first, second = np.flatnonzero(maps.degaussed)
    assert not np.isfinite(maps.coefficients[first]).any() and np.isfinite(maps.coefficients[second]).all()
    assert not maps.segment.any() and not maps.reference[maps.label.index("reference 2")]
    assert (maps.moved_s()[[first, second]] == 1e-9 * (maps.stamp_ns - maps.stamp_ns[0])[[first - 1, second - 1]]).all()

    del outcome.records[second:]
    again = Procedure(plan, mirror, bench, outcome=outcome).run()
    assert [move.degauss for move in bench.moves].count(True) == 5  # as a run goes on, and its own
    assert again.maps().degaussed.sum() == 2


def test_what_a_degauss_wiped_is_no_noise(bench: LinearBench, mirror: Mirror) -> None:
    """Before one of them comes a reference frame here, of the same command as the map after it."""
    maps = run(bench, mirror, PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=250)).outcome.maps()
    first = int(np.flatnonzero(maps.degaussed)[0])
    assert maps.kind[first - 1] == "reference" and (maps.applied[first] == maps.applied[first - 1]).all()
    wiped = np.array(maps.coefficients)
    wiped[first] += 5e-8
    np.testing.assert_array_equal(replace(maps, coefficients=wiped).noise_variance(), maps.noise_variance())


def test_a_reference_frame_may_differ_by_what_a_degauss_wiped(bench: LinearBench, mirror: Mirror) -> None:
    reference, poke = run(bench, mirror).outcome.records[:2]
    change = 0.8 * (poke.coefficients - reference.coefficients)
    changed = replace(reference, coefficients=reference.coefficients + change)
    check = BumpCheck(BumpOptions(tilt_max=0.0), mirror, 0.1)
    check.take(reference)
    check.take(poke)
    assert "the figure changed by" in check.change(changed, False)
    check.degaussed()
    assert check.change(changed, False) == ""


def test_a_failed_measurement_is_tried_again(bench: LinearBench, mirror: Mirror) -> None:
    bench.failing = {"poke+03": 2}
    outcome = run(bench, mirror, measure_retries=2).outcome
    assert bench.tries.count("poke+03") == 3
    assert outcome.dropped == []
    assert "poke+03" in [record.label for record in outcome.records]


def test_a_state_without_a_map_is_dropped_and_reported(bench: LinearBench, mirror: Mirror) -> None:
    bench.failing = {"poke+03": 9}
    outcome = run(bench, mirror, measure_retries=1).outcome
    assert outcome.dropped == ["poke+03: no map within 5 s (2 tries)"]
    assert len(outcome.records) == len(make_plan(PlanKind.POKES, mirror).steps) - 2


def test_several_states_without_a_map_end_the_run(bench: LinearBench, mirror: Mirror) -> None:
    bench.failing = dict.fromkeys(("poke+02", "poke-02", "poke+03"), 99)
    with pytest.raises(Refusal, match="3 states in a row gave no map; the last: no map within 5 s") as caught:
        run(bench, mirror)
    assert caught.value.error_code == 302
    assert "poke-03" not in bench.tries


def test_failures_that_are_not_in_a_row_do_not_end_it(bench: LinearBench, mirror: Mirror) -> None:
    bench.failing = dict.fromkeys(("poke+01", "poke-02", "poke+04", "poke-05"), 99)
    assert len(run(bench, mirror).outcome.dropped) == 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radius": 10e-3}, "aperture radius 10.000 mm, the mirror's is 11.000 mm +-2.0%: never mix"),
        ({"wavelength": 1064e-9}, "wavelength 1064.000 nm, in the maps before 632.800 nm (0 = not known): never mix"),
        ({"wavelength": 0.0}, "wavelength 0.000 nm"),
        ({"system_error_subtracted": 1}, "never mix"),
        ({"coefficients": np.zeros(15)}, "15 Zernike terms"),
        ({"points": LinearMirror(np.zeros(1), np.zeros(1)).points.__class__(*np.zeros((3, 300)))}, "other points"),
    ],
)
def test_maps_that_cannot_be_compared_are_dropped(
    bench: LinearBench, mirror: Mirror, change: dict[str, object], words: str
) -> None:
    bench.changes = {"poke+02": change}
    outcome = run(bench, mirror).outcome
    assert len(outcome.dropped) == 1
    assert outcome.dropped[0].startswith("poke+02: ") and words in outcome.dropped[0]
    outcome.maps()


def test_unknown_radius_is_remembered(bench: LinearBench, mirror: Mirror) -> None:
    bench.changes = {"poke+02": {"radius": 0.0}}
    assert not run(bench, mirror).outcome.radius_known


def test_several_maps_per_state(bench: LinearBench, mirror: Mirror) -> None:
    outcome = run(bench, mirror, maps_per_state=3).outcome
    labels = [record.label for record in outcome.records]
    assert labels[:4] == ["reference 1", "reference 1 (2)", "reference 1 (3)", "poke+01"]
    assert len({record.step for record in outcome.records[:3]}) == 1
    assert len(bench.applied) * 3 == len(labels)


@pytest.mark.parametrize("label", ["reference 1", "poke+01", "poke-05", "reference 2"])
def test_cancel_is_noticed_within_one_step(bench: LinearBench, mirror: Mirror, label: str) -> None:
    bench.stop_at = label
    with pytest.raises(Cancelled):
        run(bench, mirror)
    assert bench.tries[-1] == label


def test_a_failing_driver_ends_the_run_and_keeps_the_maps(bench: LinearBench, mirror: Mirror) -> None:
    plan = make_plan(PlanKind.POKES, mirror)
    procedure = Procedure(plan, mirror, bench)
    good = bench.apply

    def apply(signals: np.ndarray) -> np.ndarray:
        if len(bench.applied) == 5:
            raise Refusal(201, "set_signals: the link broke")
        return good(signals)

    bench.apply = apply  # type: ignore[method-assign]
    with pytest.raises(Refusal, match="the link broke"):
        procedure.run()
    assert len(procedure.outcome.records) == 5


def test_shapes_are_solved_from_the_pokes_of_the_run() -> None:
    mirror = make_mirror()
    bench = LinearBench(mirror)
    outcome = run(bench, mirror, PlanKind.FULL).outcome
    assert outcome.dropped == []
    sphere = next(record for record in outcome.records if record.label == "p57")
    assert sphere.nominal is not None
    assert sphere.coefficients[3:] == pytest.approx(sphere.nominal[3:], abs=10e-9)
    assert any(target.startswith("p57: sphere of radius +100 m") for target in outcome.targets)
    assert outcome.remarks == []
    maps = outcome.maps()
    assert np.isfinite(maps.nominal).all(axis=1).sum() == 15


def test_shapes_without_a_model_are_dropped_in_words(bench: LinearBench, mirror: Mirror) -> None:
    plan = make_plan(PlanKind.SURFACES, mirror, PlanOptions(surfaces=("p01", "p55")))
    procedure = Procedure(plan, mirror, bench)
    outcome = procedure.run()
    assert len(outcome.dropped) == 1
    assert outcome.dropped[0].startswith("p55: its signals need an influence function")
    assert [record.label for record in outcome.records] == ["reference 1", "p01", "reference 2"]


def test_progress_counts_the_steps(bench: LinearBench, mirror: Mirror) -> None:
    seen: list[Progress] = []
    plan = make_plan(PlanKind.POKES, mirror)
    Procedure(plan, mirror, bench, progress=seen.append).run()
    assert [progress.done for progress in seen] == list(range(len(plan.steps) + 1))
    assert all(progress.steps == len(plan.steps) for progress in seen)
    assert seen[0].kind is StepKind.DEGAUSS
    assert seen[-1].residual_rms == 2e-9


def test_a_run_that_ends_early_has_done_the_steps_until_then(bench: LinearBench, mirror: Mirror) -> None:
    seen: list[Progress] = []
    plan = make_plan(PlanKind.HYSTERESIS, mirror, PlanOptions(hysteresis_maps=240, until=1e-9))
    Procedure(plan, mirror, bench, progress=seen.append, enough=lambda outcome: True).run()
    end = min(plan.ends)
    assert [progress.done for progress in seen] == list(range(end + 1))
    assert (seen[-2].steps, seen[-1].steps, seen[-1].label) == (len(plan.steps), end, plan.steps[end - 1].label)


def test_no_maps_at_all(bench: LinearBench, mirror: Mirror) -> None:
    with pytest.raises(TooFewMapsError, match="no map was measured"):
        Procedure(make_plan(PlanKind.POKES, mirror), mirror, bench).outcome.maps()


@pytest.mark.parametrize(("kind", "count"), [(StepKind.CHECK, 60), (StepKind.IN_USE, 83)])
def test_shapes_as_in_use_are_on_the_flat_surface(kind: StepKind, count: int) -> None:
    """As in use: the figure is gone, and what is left is the shape of the plan."""
    mirror = make_mirror(neighbour_difference_max=1.0)
    plant = LinearMirror(mirror.x, mirror.y)
    plant.figure_coefficients *= 5.0
    outcome = run(LinearBench(mirror, plant), mirror, PlanKind.HYSTERESIS).outcome
    steps = make_plan(PlanKind.HYSTERESIS, mirror).steps
    planned = {step.label: step.signals for step in steps if step.signals is not None}
    checks = [record for record in outcome.records if record.kind == kind.value]
    assert len(checks) == count
    shapes = np.array([plant.influence @ planned[record.label] for record in checks])
    left = np.array([record.coefficients for record in checks]) - plant.fit_terms(shapes)
    size = np.median(np.abs(left[:, 3:]).max(axis=1))
    assert size < 0.1 * np.abs(plant.figure_coefficients).max()
    assert all((mirror.limits.differences(record.signals) <= 1.0).all() for record in checks)


@pytest.mark.parametrize("pitch", [1.1e-4, 0.0])
def test_where_a_coarse_map_ends_is_not_known_to_a_pixel(pitch: float, mirror: Mirror) -> None:
    frame = LinearMirror(mirror.x, mirror.y).measurement(
        np.zeros(300), 1, kind="reference", radius_px=100.0, pitch=pitch
    )
    check = BumpCheck(BumpOptions(), mirror, 0.1)
    check.take(replace(frame, centre=(0.0, 0.0)))
    assert check.change(replace(frame, centre=(1.2, 0.0)), False) == ""
    assert "the mirror moved by" in check.change(replace(frame, centre=(2.0, 0.0)), False)


def test_the_figure_of_a_mirror_of_one_actuator_is_compared_too() -> None:
    mirror = make_mirror(rings=0)
    bench = LinearBench(mirror)
    bench.changes["reference 2"] = {"coefficients": 1e-6 * np.eye(21)[4]}
    with pytest.raises(Refusal, match="the figure changed by"):
        run(bench, mirror)


def test_what_failed_after_a_bump_is_measured_again(bench: LinearBench, mirror: Mirror) -> None:
    first, *others = run(bench, mirror).outcome.records
    outcome = Outcome()
    for event in (
        MapTaken(first),
        Dropped(2, "poke+01: it was bad"),
        MapTaken(others[1]),
        Dropped(9, "a bowl: out of reach", whole=True),
        Dropped(4, "poke+02: 30 % of the pixels"),
        MapTaken(others[3]),
    ):
        outcome.take(event)
    outcome.take(Doubted(2, "bumped"))
    assert [step for step in range(10) if outcome.tried(step)] == [1, 2, 3, 9]
    assert outcome.dropped == ["poke+01: it was bad", "a bowl: out of reach", f"{others[3].label}: bumped"]


@pytest.mark.parametrize(
    ("kind", "stop_at", "before", "after"),
    [
        # Maps 1 and 3 of a state fail, then the run is interrupted.
        (PlanKind.POKES, "poke+03 (3)", ["poke+03", "poke+03 (3)"], []),
        # The run is interrupted after map 1 of a state; the others fail when it is resumed.
        (PlanKind.HYSTERESIS, "excitation 30", [], ["excitation 30 (2)", "excitation 30 (3)"]),
    ],
)
def test_labels_stay_unique_where_a_state_is_continued(
    kind: PlanKind, stop_at: str, before: list[str], after: list[str], bench: LinearBench, mirror: Mirror
) -> None:
    plan = make_plan(kind, mirror, PlanOptions(hysteresis_maps=60))
    options = ProcedureOptions(maps_per_state=3, measure_retries=0)
    outcome = Outcome()
    bench.failing, bench.stop_at = dict.fromkeys(before, 1), stop_at
    with pytest.raises(Cancelled):
        Procedure(plan, mirror, bench, options, cancelled=lambda: bench.stopped, outcome=outcome).run()
    bench.stopped, bench.stop_at, bench.failing = False, "", dict.fromkeys(after, 1)
    Procedure(plan, mirror, bench, options, outcome=outcome).run()
    shown = [label for label in outcome.maps().label if label.startswith(stop_at.removesuffix(" (3)"))]
    assert len(shown) == 2


def test_a_move_without_a_map_may_have_left_hysteresis(mirror: Mirror) -> None:
    bench = LinearBench(mirror, backlash=0.2, share=0.3)
    bench.failing = {"poke-03": 9}
    assert len(run(bench, mirror, plan_options=PlanOptions(reference_every=1)).outcome.dropped) == 1


def test_a_command_without_a_map_is_kept_and_counts_as_none(bench: LinearBench, mirror: Mirror) -> None:
    bench.failing = {"excitation 30": 9}
    outcome = run(bench, mirror, PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=60)).outcome
    assert outcome.maps().label.count("excitation 30") == 1 and len(outcome.dropped) == 1
    assert outcome.measured == len(outcome.records) - 1


def test_a_bump_puts_the_maps_since_in_doubt_not_the_commands_without_one(bench: LinearBench, mirror: Mirror) -> None:
    plan = make_plan(PlanKind.HYSTERESIS, mirror, PlanOptions(hysteresis_maps=150))
    before, bumped = [index for index, step in enumerate(plan.steps) if step.kind is StepKind.REFERENCE][-2:]
    bench.failing = {"excitation 30": 9}
    bench.changes = {plan.steps[bumped].label: {"coefficients": np.full(21, 1e-6)}}
    outcome, since = Outcome(), bumped - before - 2
    with pytest.raises(Refusal, match=f"bumped, and {since} maps since are in doubt"):
        Procedure(plan, mirror, bench, outcome=outcome).run()
    assert sum("in doubt, bumped before" in entry for entry in outcome.dropped) == since


@pytest.mark.parametrize("back_s", [3, 60])
def test_a_clock_set_back_spoils_no_run(back_s: int, bench: LinearBench, mirror: Mirror) -> None:
    """Maps wait for it to catch up, else the run ends and is resumed later."""
    plan, outcome = make_plan(PlanKind.HYSTERESIS, mirror, PlanOptions(hysteresis_maps=60)), Outcome()

    def set_back(progress: Progress) -> None:
        if progress.done == 10:
            bench.clock_ns -= back_s * 10**9

    procedure = Procedure(plan, mirror, bench, outcome=outcome, progress=set_back)
    if back_s > 10:
        with pytest.raises(Refusal, match="that of the map before it: must not be earlier; was the clock set back"):
            procedure.run()
        bench.clock_ns += back_s * 10**9
        procedure = Procedure(plan, mirror, bench, outcome=outcome)
    maps = procedure.run().maps()
    assert (np.diff(maps.stamp_ns) >= 0).all() and len(outcome.dropped) <= 2
