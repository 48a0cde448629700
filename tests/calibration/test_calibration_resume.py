"""A run that was cut off goes on from its last good map and ends as an uninterrupted one would have."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dm_msgs.action import Calibrate

from dm_calibration.calibration_action import CalibrateAction
from dm_calibration.calibrator import Provenance, calibrate, fit_effective
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.hysteresis_fit import fit_hysteresis
from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.event_frames import _EVENTS, Storing
from dm_calibration.procedure.outcome import Event, MapTaken
from dm_calibration.procedure.plan import Plan, PlanKind, PlanOptions, StepKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_calibration.procedure.resumable_run import OpenRun, identity_of, open_run
from dm_calibration.procedure.run_journal import EVENTS, MANIFEST, read_run
from dm_calibration.procedure.unfinished_runs import UnfinishedRuns
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.atomic_write import StoreError
from dm_common.errors import ErrorCode, Refusal
from dm_common.measurement import Measurement
from dm_common.optics.zernike import basis
from hysteretic_mirror import MIRROR, lagging_bench
from map_hashes import map_hashes, record_hash
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig

pytestmark = pytest.mark.slow

POKES = make_plan(PlanKind.POKES, MIRROR)


class PowerCut(Exception):
    """The end of the process, wherever it comes."""


def opened(folder: Path, plan: Plan, fresh: bool = False, age_max: float = 3600.0, **settings: object) -> OpenRun:
    identity = identity_of(plan, PlanOptions(), MIRROR, settings, {})
    with UnfinishedRuns(folder) as runs:
        return open_run(runs, identity, plan, age_max, fresh)


def cut_before(count: int) -> Callable[[Event], None]:
    """A power cut as map `count` is to be kept."""
    seen = 0

    def check(event: Event) -> None:
        nonlocal seen
        seen += isinstance(event, MapTaken)
        if seen > count:
            raise PowerCut

    return check


def procedure(
    run: OpenRun, plan: Plan, bench: object, check: Callable[[Event], None] = lambda event: None
) -> Procedure:
    def keep(event: Event) -> None:
        check(event)
        run.journal.keep(event)

    return Procedure(plan, MIRROR, bench, outcome=run.outcome, keep=keep)  # type: ignore[arg-type]


def test_each_map_is_measured_once_however_often_the_power_fails(tmp_path: Path) -> None:
    bench = lagging_bench()
    measured: dict[str, str] = {}
    good = bench.measure
    taken: list[str] = []

    def measure(label: str) -> Measurement:
        taken.append(label)
        return good(label)

    bench.measure = measure  # type: ignore[method-assign]

    def cut(event: Event) -> None:
        if isinstance(event, MapTaken):
            measured[event.record.label] = record_hash(event.record)
            if len(measured) % 9 == 8:
                run.journal.keep(event)
                raise PowerCut

    cuts = 0
    while True:
        run = opened(tmp_path, POKES)
        try:
            outcome = procedure(run, POKES, bench, cut).run()
            break
        except PowerCut:
            cuts += 1
            run.journal.close()
    assert cuts >= 9
    assert len(taken) == len(set(taken)) == len(outcome.records)
    planned = {step.label for step in POKES.steps if step.kind is not StepKind.DEGAUSS}
    assert {label for label in taken if "resumed" not in label} == planned
    assert map_hashes(outcome.maps()) == [measured[record.label] for record in outcome.records]


def test_what_is_read_back_is_bit_for_bit_what_was_measured(tmp_path: Path) -> None:
    run, bench = opened(tmp_path, POKES), lagging_bench()
    good = bench.measure
    turned = {"orientation": (True, False, 90.0), "camera": (640, 480), "pitch": 5e-5, "reference_surface": "flat"}
    place = {"centre": (320.5, 239.0), "followed": (319.0, 240.0), "radius_px": 200.0}
    bench.measure = lambda label: replace(good(label), **turned, **place)  # type: ignore[method-assign,arg-type]
    live = procedure(run, POKES, bench).run()
    again = read_run(run.journal.folder).outcome
    for name in (*turned, *place):  # what a wrong poke check is mended by
        assert [getattr(each, name) for each in again.records] == [getattr(each, name) for each in live.records]
    assert map_hashes(again.maps()) == map_hashes(live.maps())
    calibration = calibrate(again, mirror=MIRROR, options=FitOptions(), provenance=Provenance("resumed", 1))
    store = CalibrationStore(tmp_path)
    store.save(calibration)
    assert map_hashes(store.load("resumed").maps) == [record_hash(record) for record in live.records]


def test_shapes_solved_before_and_after_a_power_cut_come_from_the_same_pokes(tmp_path: Path) -> None:
    plan = make_plan(PlanKind.FULL, MIRROR)
    order = [step.label for step in plan.steps]
    run = opened(tmp_path, plan)
    with pytest.raises(PowerCut):
        procedure(run, plan, lagging_bench(), cut_before(order.index("p57") - 1)).run()
    run.journal.close()
    resumed = procedure(opened(tmp_path, plan), plan, lagging_bench()).run()
    whole = Procedure(plan, MIRROR, lagging_bench()).run()
    assert resumed.targets[:2] == run.outcome.targets[:2]
    assert [target.partition(":")[0] for target in resumed.targets] == [t.partition(":")[0] for t in whole.targets]
    assert {record.label for record in whole.records} == {
        record.label for record in resumed.records if "resumed" not in record.label
    }


@pytest.mark.parametrize("torn", [1, 40, 2000])
def test_a_torn_last_frame_is_cut_off(tmp_path: Path, torn: int) -> None:
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(5)).run()
    run.journal.close()
    events = run.journal.folder / EVENTS
    events.write_bytes(events.read_bytes()[:-torn])
    again = opened(tmp_path, POKES)
    assert [record.label for record in again.outcome.records] == [r.label for r in run.outcome.records[:4]]
    outcome = procedure(again, POKES, lagging_bench()).run()
    assert {step.label for step in POKES.steps[1:]} <= {record.label for record in outcome.records}


def test_damage_in_the_middle_is_not_taken_for_a_map(tmp_path: Path) -> None:
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(9)).run()
    events = run.journal.folder / EVENTS
    content = bytearray(events.read_bytes())
    content[len(content) // 2] ^= 1
    events.write_bytes(content)
    kept = read_run(run.journal.folder)
    hashes = [record_hash(record) for record in kept.outcome.records]
    assert 0 < len(hashes) < 9 and kept.torn > 0
    assert hashes == [record_hash(record) for record in run.outcome.records[: len(hashes)]]


def test_only_the_same_plan_settings_and_mirror_go_on(tmp_path: Path) -> None:
    def begin() -> OpenRun:
        run = opened(tmp_path, POKES, settle=1)
        if not run.resumed:
            with pytest.raises(PowerCut):
                procedure(run, POKES, lagging_bench(), cut_before(3)).run()
        run.journal.close()
        return run

    first = begin()
    other = opened(tmp_path, POKES, settle=2)
    assert not other.resumed and any(
        "other settings: only the goal that began it resumes it" in note for note in other.notes
    )
    assert begin().resumed == f"resumed run {first.journal.folder.name} with 3 maps"
    fresh = opened(tmp_path, POKES, fresh=True, settle=1)
    assert not fresh.resumed and any("3 maps) is set aside: a fresh run" in note for note in fresh.notes)
    assert len(list((tmp_path / "unfinished").glob("*.set-aside"))) == 1
    begin()
    assert not opened(tmp_path, POKES, age_max=0.0, settle=1).resumed


def test_a_run_that_goes_on_is_not_deleted_for_being_the_oldest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dm_calibration.procedure.unfinished_runs.WAITING_MAX", 0)
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(3)).run()
    run.journal.close()
    assert opened(tmp_path, POKES).resumed.endswith("with 3 maps")


def test_a_run_of_one_map_is_told_in_the_singular(tmp_path: Path) -> None:
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(1)).run()
    run.journal.close()
    again = opened(tmp_path, POKES)
    again.journal.close()
    assert again.resumed.endswith("with 1 map")
    assert any("(1 map) is set aside: a fresh run" in note for note in opened(tmp_path, POKES, fresh=True).notes)


def test_why_a_run_does_not_go_on_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(3)).run()
    run.journal.close()

    def open_files() -> int:
        return sum(str(link.resolve()).startswith(str(tmp_path)) for link in Path("/proc/self/fd").iterdir())

    files = open_files()
    with monkeypatch.context() as full:
        full.setattr("dm_calibration.procedure.run_journal.os.fdatasync", lambda _: os.fsync(10**6))
        with pytest.raises(StoreError, match="no room for the maps"):
            opened(tmp_path, POKES)
    assert open_files() == files
    monkeypatch.delitem(_EVENTS, "MapTaken")
    other = opened(tmp_path, POKES)
    assert not other.resumed and "'MapTaken' of another version" in " ".join(other.notes)


def test_a_damaged_manifest_stops_no_goal_and_one_that_is_gone_is_no_run(tmp_path: Path) -> None:
    runs = [opened(tmp_path, POKES, number=number) for number in range(2)]
    damaged, removed = (run.journal.folder / MANIFEST for run in runs)
    damaged.write_text(json.dumps(json.loads(damaged.read_text()) | {"identity": None}))
    removed.unlink()  # the power failed while the journal of a finished run was deleted
    assert opened(tmp_path, POKES).notes == (
        f"unfinished run {runs[0].journal.folder.name}: {MANIFEST} does not name the plan and settings of the run",
    )


def test_what_failed_last_is_tried_again(tmp_path: Path) -> None:
    bench = lagging_bench()
    good = bench.measure

    def measure(label: str) -> Measurement:
        if label in ("poke+02", "poke-02", "poke+03"):
            raise Refusal(306, "no interferometer node answered")
        return good(label)

    bench.measure = measure  # type: ignore[method-assign]
    run = opened(tmp_path, POKES)
    with pytest.raises(Refusal):
        procedure(run, POKES, bench).run()
    run.journal.close()
    bench.measure = good  # type: ignore[method-assign]
    again = opened(tmp_path, POKES)
    outcome = procedure(again, POKES, bench).run()
    assert outcome.dropped == []
    assert {"poke+02", "poke-02", "poke+03"} <= {record.label for record in outcome.records}


def test_a_disk_that_fills_up_costs_one_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = opened(tmp_path, POKES)
    written = 0

    def full(handle: int, content: bytes, position: int) -> int:
        nonlocal written
        written += 1
        if written == 6:
            return write(handle, bytes(content)[:100], position)
        if written > 6:
            raise OSError(28, "No space left on device")
        return write(handle, content, position)

    write = os.pwrite
    monkeypatch.setattr("dm_calibration.procedure.run_journal.os.pwrite", full)
    with pytest.raises(StoreError, match=r"map poke.*could not be stored in .*No space left"):
        procedure(run, POKES, lagging_bench()).run()
    run.journal.close()
    assert len(read_run(run.journal.folder).outcome.records) == len(run.outcome.records) >= 2


def test_two_nodes_do_not_calibrate_into_one_folder(tmp_path: Path) -> None:
    with UnfinishedRuns(tmp_path), pytest.raises(Refusal, match="another node is calibrating"):
        UnfinishedRuns(tmp_path).__enter__()


def interrupted(
    kind: PlanKind, config: SimulationConfig, folder: Path, cuts: tuple[int, ...], maps: int = 100
) -> MapSet:
    """The maps of a run on the simulation, cut off before some of them, with the power off for an hour each time."""
    bench = SimulatedBench(config)
    options = PlanOptions(hysteresis_maps=maps)
    plan = make_plan(kind, bench.mirror, options)
    identity = identity_of(plan, options, bench.mirror, {}, {})
    for cut in (*cuts, 10**9):
        with UnfinishedRuns(folder) as runs:
            run = open_run(runs, identity, plan, 3600.0)
        check = cut_before(cut - len(run.outcome.records))

        def keep(event: Event, run: OpenRun = run, check: Callable[[Event], None] = check) -> None:
            check(event)
            run.journal.keep(event)

        try:
            Procedure(plan, bench.mirror, bench, outcome=run.outcome, keep=keep).run()
        except PowerCut:
            run.journal.close()
            bench.power_cycle(3600.0)
    return run.outcome.maps()


def test_an_interrupted_hysteresis_run_knows_the_law_as_well(tmp_path: Path) -> None:
    config = SimulationConfig(seed=90125)
    laws = [candidate for candidate in CANDIDATES if candidate.name in ("linear", "Prandtl-Ishlinskii")]
    whole = fit_hysteresis(interrupted(PlanKind.HYSTERESIS, config, tmp_path / "whole", ()), candidates=laws)
    maps = interrupted(PlanKind.HYSTERESIS, config, tmp_path / "parts", (30, 70))
    assert np.unique(maps.segment).size == 3
    parts = fit_hysteresis(maps, candidates=laws)
    assert parts.held_out_max_zernike < 2.0 * whole.held_out_max_zernike < 6e-9
    assert parts.law.creep_rate == pytest.approx(whole.law.creep_rate, rel=0.1)
    blind = fit_hysteresis(replace(maps, segment=np.zeros_like(maps.segment)), candidates=laws)
    assert blind.held_out_max_zernike > 2.0 * parts.held_out_max_zernike  # what not knowing of the cuts would cost


def test_a_figure_that_changed_in_an_interruption_is_no_creep(tmp_path: Path) -> None:
    laws = [candidate for candidate in CANDIDATES if candidate.name == "Prandtl-Ishlinskii"]
    maps = interrupted(PlanKind.HYSTERESIS, SimulationConfig(seed=90125), tmp_path, (60,))
    bent = np.zeros(21)
    bent[3:6] = 20e-9, 10e-9, -10e-9
    change = np.outer(maps.segment, bent)
    modes = basis(maps.points.x, maps.points.y)
    changed = replace(maps, coefficients=maps.coefficients + change, sag=maps.sag + change @ modes.T)
    before, after = (
        fit_effective(each, fit_hysteresis(each, candidates=laws), FitOptions(), MIRROR) for each in (maps, changed)
    )
    assert after.zernike_offset - before.zernike_offset == pytest.approx(bent, abs=2e-9)


@pytest.mark.parametrize(("law", "figure"), [("none", 2.5e-9), ("prandtl_ishlinskii", 25e-9)])
def test_an_interrupted_poke_run_predicts_as_well(law: str, figure: float, tmp_path: Path) -> None:
    config = SimulationConfig(law=law, seed=90125)
    whole = fit_influence(interrupted(PlanKind.POKES, config, tmp_path / "whole", ()))
    parts = fit_influence(interrupted(PlanKind.POKES, config, tmp_path / "parts", (20, 55)))
    assert parts.held_out_rms < 1.2 * whole.held_out_rms < 1.2 * figure
    difference = np.linalg.norm(parts.influence_sag - whole.influence_sag)
    assert difference < 0.05 * np.linalg.norm(whole.influence_sag)


def test_a_run_killed_while_it_was_stored_measures_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may have ended before its plan did: other maps than those that are stored would be refused for ever."""
    run = opened(tmp_path, POKES)
    with pytest.raises(PowerCut):
        procedure(run, POKES, lagging_bench(), cut_before(5)).run()
    run.journal.keep(Storing("stored", 1))
    run.journal.close()
    again = opened(tmp_path, POKES)
    concluded: list[OpenRun] = []
    services = SimpleNamespace(rest=lambda _signals: "", settle_time=0.0, map_time=0.0)
    handle = SimpleNamespace(request=Calibrate.Goal(), publish_feedback=lambda _feedback: None)
    manager = SimpleNamespace(known_mirror=lambda: MIRROR, driver_facts={})
    action: Any = CalibrateAction(SimpleNamespace(), {}, services, manager, handle)  # type: ignore[arg-type]
    action._plan, action._mirror = POKES, MIRROR
    unmoved = SimpleNamespace(run=lambda: pytest.fail("the procedure runs again"))
    monkeypatch.setattr(action, "_opened", lambda *_: again)
    monkeypatch.setattr(action, "_procedure", lambda *_: unmoved)
    monkeypatch.setattr(action, "_conclude", lambda run, *_: concluded.append(run))
    action._run_kept(None)
    assert [run.storing for run in concluded] == [Storing("stored", 1)]
    assert len(again.outcome.records) == 5


def test_a_run_that_is_cancelled_while_it_is_fitted_is_kept_and_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = opened(tmp_path, POKES)
    outcome = procedure(run, POKES, lagging_bench()).run()
    made = calibrate(outcome, mirror=MIRROR, provenance=Provenance("new", 1))
    services = SimpleNamespace(rest=lambda _signals: "", settle_time=0.0, map_time=0.0, cancelled=lambda: True)
    handle = SimpleNamespace(request=Calibrate.Goal(activate=True), publish_feedback=lambda _feedback: None)
    manager = SimpleNamespace(known_mirror=lambda: MIRROR, driver_facts={})  # which is asked to keep nothing
    action: Any = CalibrateAction(SimpleNamespace(), {}, services, manager, handle)  # type: ignore[arg-type]
    action._plan, action._mirror = POKES, MIRROR
    monkeypatch.setattr(action, "_opened", lambda *_: run)
    monkeypatch.setattr(action, "_procedure", lambda *_: SimpleNamespace(run=lambda: None))
    monkeypatch.setattr(action, "_calibration", lambda _run: made)
    action._run_kept(None)
    assert action._result.error_code == ErrorCode.CANCELED and action._result.id == ""
    assert f"{len(outcome.records)} maps are kept" in action._result.message
    again = opened(tmp_path, POKES)
    assert again.storing is None and len(again.outcome.records) == len(outcome.records)
