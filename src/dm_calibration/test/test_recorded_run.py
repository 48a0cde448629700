"""A calibration made again from what a recording holds."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from dm_calibration.influence.fit import fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.procedure.recorded_run import RecordingError, repeat_run
from recorded_bench import recorded


def assert_same_maps(one: MapSet, other: MapSet) -> None:
    for column in fields(MapSet):
        a, b = getattr(one, column.name), getattr(other, column.name)
        if isinstance(a, np.ndarray):
            assert a.tobytes() == b.tobytes(), column.name
        elif column.name != "points":
            assert a == b, column.name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (PlanKind.FULL, PlanOptions()),
        (PlanKind.POKES, PlanOptions(poke_amplitude=0.37, reference_every=7)),
        (PlanKind.FULL, PlanOptions(degauss=False, reference_every=25, surfaces=("p03", "pz02"))),
    ],
)
def test_a_run_made_again_is_the_same_to_the_last_bit(kind: PlanKind, options: PlanOptions) -> None:
    run, outcome = recorded(kind, options)
    plan, again = repeat_run(run)
    assert plan.kind is kind
    assert_same_maps(again.maps(), outcome.maps())
    live, replayed = fit_influence(outcome.maps()), fit_influence(again.maps())
    assert replayed.influence_sag.tobytes() == live.influence_sag.tobytes()
    assert replayed.influence_zernike.tobytes() == live.influence_zernike.tobytes()


@pytest.mark.slow
def test_a_run_that_was_accurate_enough_ends_where_it_did() -> None:
    options = PlanOptions(hysteresis_maps=300, until=2e-9)
    run, outcome = recorded(PlanKind.HYSTERESIS, options, enough=lambda outcome: len(outcome.records) > 150)
    assert 150 < len(outcome.records) < 220
    assert_same_maps(repeat_run(run)[1].maps(), outcome.maps())
    with pytest.raises(RecordingError, match="other signals were commanded"):
        repeat_run(replace(run, moves=(*run.moves[:150], *run.moves[151:])))


def test_states_without_a_map_stay_without_one() -> None:
    run, outcome = recorded(PlanKind.POKES, PlanOptions(), failing=frozenset({"poke+03", "reference 2"}))
    again = repeat_run(run)[1]
    assert_same_maps(again.maps(), outcome.maps())
    assert [entry.partition(":")[0] for entry in again.dropped] == ["poke+03", "reference 2"]


def test_several_maps_of_a_state_are_taken_again() -> None:
    run, outcome = recorded(PlanKind.POKES, PlanOptions(), maps_per_state=3)
    assert_same_maps(repeat_run(run)[1].maps(), outcome.maps())


def test_a_lost_move_is_told() -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    with pytest.raises(RecordingError, match="other signals were commanded"):
        repeat_run(replace(run, moves=run.moves[:20] + run.moves[21:]))


def test_a_recording_that_ends_early_is_told() -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    with pytest.raises(RecordingError, match="the recording ends before it"):
        repeat_run(replace(run, moves=run.moves[:40]))


def test_a_recording_of_an_earlier_version_is_refused() -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    with pytest.raises(RecordingError, match="lacks the plan of the run"):
        repeat_run(replace(run, plan=""))


def test_another_command_is_not_taken_for_the_plans() -> None:
    run, _outcome = recorded(PlanKind.POKES, PlanOptions())
    touched = run.moves[5].requested.copy()
    touched[0] = np.nextafter(touched[0], 1.0)
    moves = (*run.moves[:5], replace(run.moves[5], requested=touched), *run.moves[6:])
    with pytest.raises(RecordingError, match="other signals were commanded"):
        repeat_run(replace(run, moves=moves))
