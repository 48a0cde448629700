"""`./dm compare --mirrors`: mirrors drawn at random, and what is told of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from dm_simulation.mirror.hysteresis import LAWS
from studies.comparison import drawn_mirrors, population
from studies.comparison.drawn_mirrors import draw_mirror
from studies.comparison.few_maps import HADAMARD, PUSH_PULL, FewMaps, judge_few_maps, patterns
from studies.comparison.population import (
    ANY_ORDER,
    CHECKED,
    POWER_CUT,
    RECIPES,
    RESTARTED,
    Outcome,
    PopulationOptions,
    judge_population,
)
from studies.comparison.random_requests import Requests
from studies.comparison.simulated_bench import SimulatedBench
from studies.verbs.compare import compare as command
from studies.verbs.compare_maps import row_of as row_of_method
from studies.verbs.compare_maps import show as show_maps
from studies.verbs.compare_mirrors import figures_of, row_of, show

#: Tried by `common_laws`: that of the mirror that is judged among them.
TRIED_LAWS = ("linear", "Preisach")


def test_a_seed_is_always_the_same_mirror_and_seeds_differ() -> None:
    assert draw_mirror(7) == draw_mirror(7)
    mirrors = [draw_mirror(seed) for seed in range(200)]
    laws = [mirror.simulation.law for mirror in mirrors]
    assert set(laws) == set(drawn_mirrors.LAWS) <= set(LAWS)
    assert {mirror.event for mirror in mirrors} == set(drawn_mirrors.EVENTS)
    assert len({mirror.simulation.hysteresis for mirror in mirrors}) == len(mirrors)
    assert all(mirror.simulation.neighbour_difference == 1.0 for mirror in mirrors)
    figures = np.array([mirror.simulation.instrument.figure_rms for mirror in mirrors])
    assert 40e-9 <= figures.min() < figures.max() <= 500e-9


@pytest.mark.slow
@pytest.mark.usefixtures("common_laws")
def test_a_mirror_is_judged_and_its_figures_are_told() -> None:
    options = PopulationOptions(requests=5, maps=90, recipes=2, pixels=100)
    (outcome,) = judge_population([3], options)
    assert not outcome.failure
    assert outcome.groups.keys() == {ANY_ORDER, RECIPES, RESTARTED, CHECKED, POWER_CUT}
    low, high = outcome.curvatures
    assert low < 0 < high
    requests = outcome.groups[ANY_ORDER]
    assert len(requests.error) + len(requests.refusals) == options.requests
    assert np.all(requests.error < 1e-7)
    row = json.loads(json.dumps(row_of(outcome), allow_nan=False))
    assert row["seed"] == 3
    assert row["mirror"].startswith("preisach, loop 11% ± 15%")
    figures = figures_of([row])
    assert figures["mirrors"] == 1
    assert figures["worst_seed"] == 3
    assert figures["median_mirror"]["p90_nm"] == pytest.approx(1e9 * requests.quantile(0.9))


def test_a_mirror_that_cannot_be_driven_fails_by_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: object) -> None:
        raise ValueError("no curvature is reachable")

    monkeypatch.setattr(population, "_evaluated", refused)
    (outcome,) = judge_population([3], PopulationOptions(pixels=100))
    assert outcome.failure == "no curvature is reachable"
    show([row_of(outcome)])
    assert "seed 3: no curvature is reachable" in capsys.readouterr().out


def test_figures_without_any_request_are_shown_as_none(capsys: pytest.CaptureFixture[str]) -> None:
    outcome = Outcome(draw_mirror(3), groups={name: Requests.none(["refused"]) for name in (ANY_ORDER, RECIPES)})
    show([row_of(outcome)])
    shown = capsys.readouterr().out
    assert "median mirror: p50 -, p90 -, recipes p90 -" in shown
    assert "every request refused: 1, not in these quantiles" in shown
    assert "1 mirrors; bound holds for 90 % or more of the requests on 0% of them" in shown


def test_mirrors_need_one_first_seed() -> None:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, ["--mirrors", "2", "--seed", "1", "--seed", "2"])
    assert result.exit_code == 2
    assert "--seed" in result.output


@pytest.mark.parametrize("others", [[], ["--mirrors", "2", "--quick"]])
def test_numbers_of_maps_are_refused_where_they_would_mean_nothing(others: list[str]) -> None:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, ["--maps", "100", *others])
    assert result.exit_code == 2
    assert "--maps" in result.output


@pytest.mark.slow
def test_pokes_of_as_many_maps_and_what_is_told_of_each_number(capsys: pytest.CaptureFixture[str]) -> None:
    """Each pattern is legal and enough of them tell all actuators; a mirror without requests is named."""
    mirror = SimulatedBench(draw_mirror(3, 100).simulation).mirror
    for method in (HADAMARD, PUSH_PULL):
        signals = patterns(method, mirror, 130)
        assert all(mirror.limits.allow(row) for row in signals)
        assert np.linalg.matrix_rank(np.column_stack((np.ones(80), signals[:80]))) == 1 + mirror.actuators
    errors = Requests(np.full(20, 2e-9), np.full(20, 3e-9), np.ones(20), ("out of reach",) * 7)
    judged = FewMaps(1, HADAMARD, 60, 60, 64.0, errors)
    short = judge_few_maps(3, PUSH_PULL, 1, pixels=100)
    assert short.failure and not len(short.requests.error)
    row = row_of_method([judged, short], HADAMARD, 60)
    assert (row["median_nm"], row["good"], row["failures"]) == (pytest.approx(2.0), 1, {3: short.failure})
    assert row["refused"] == 7  # inside the range that the calibration published: they do not vanish
    show_maps([row])
    shown = capsys.readouterr().out
    assert "1 of 2" in shown and "refused" in shown
