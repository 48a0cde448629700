"""The comparison of all methods: small runs on simulations, and the command's figures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_common.errors import UnknownNameError
from dm_controller.converge.closed_loop import LoopOptions
from dm_tools.running_suite import CURVATURES
from studies.comparison import compare as study
from studies.comparison.compare import (
    CLOSED,
    CompareOptions,
    Comparison,
    Trial,
    compare,
    fitting_limits,
    total_steps,
)
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig
from studies.solvers.registry import SOLVERS
from studies.verbs.compare import compare as command

pytestmark = pytest.mark.slow

TRIED_LAWS = ("linear", "Prandtl-Ishlinskii")
SMALL = SimulationConfig(pixels=120, degauss_steps=30)
OPTIONS = CompareOptions(SMALL, seeds=(3,), curvatures=(-0.04, 0.0, 0.02, 0.05))


@pytest.fixture(scope="module", autouse=True)
def _few_laws() -> Iterator[None]:
    """The choice among all takes most of the time and is tested elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "COMMON", [law for law in COMMON if law.name in TRIED_LAWS])
        yield


@pytest.fixture(scope="module")
def steps() -> list[str]:
    """What `comparison` has reported."""
    return []


@pytest.fixture(scope="module")
def comparison(steps: list[str]) -> Comparison:
    return compare(OPTIONS, steps.append)


def test_every_method_has_both_rows(comparison: Comparison) -> None:
    rows = comparison.rows()
    assert set(rows) == set(SOLVERS) | {name + CLOSED for name in SOLVERS}
    for name, row in rows.items():
        assert 0 < row.p50 <= row.p90
        assert row.seconds > 0
        assert (row.maps > 0) == name.endswith(CLOSED)
        assert row.maps <= 3


def test_closing_the_loop_helps_every_method(comparison: Comparison) -> None:
    rows = comparison.rows()
    for name in SOLVERS:
        assert rows[name + CLOSED].p50 < 0.5 * rows[name].p50, name
    assert rows["bounded" + CLOSED].p50 < 632.8e-9 / 100


def test_nobody_beats_the_fitting_limit(comparison: Comparison) -> None:
    bench = SimulatedBench(SimulationConfig(pixels=120, seed=3))
    limit = dict(zip(CURVATURES, fitting_limits(bench, CURVATURES), strict=True))
    for trial in comparison.trials:
        assert trial.rms >= limit[trial.curvature] * (1 - 1e-9)
    assert comparison.fitting_limit == pytest.approx(max(limit[c] for c in (-0.04, 0.0, 0.02, 0.05)), rel=1e-6)
    assert comparison.rows()["bounded" + CLOSED].rms_share < 2 * comparison.fitting_limit_share


def test_the_fitting_limit_is_reached_by_an_ideal_mirror() -> None:
    """No hysteresis, no creep: the open-loop bounded programme comes within noise of the limit."""
    simulation = SimulationConfig(law="none", creep=0.0, pixels=120, degauss_steps=2)
    figures = compare(CompareOptions(simulation, seeds=(4,), methods=("bounded",), curvatures=(-0.02, 0.03)))
    open_loop = [trial for trial in figures.trials if not trial.closed]
    limits = fitting_limits(SimulatedBench(SimulationConfig(pixels=120, seed=4)), [t.curvature for t in open_loop])
    for trial, limit in zip(open_loop, limits, strict=True):
        assert limit <= trial.rms < 1.3 * limit
        assert trial.max_zernike < 1.5e-9


def test_figures_pool_all_seeds_and_leave_curvature_zero_out_of_the_share() -> None:
    trials = tuple(
        Trial(seed, "bounded", False, curvature, worst, 2e-9, 0, 1.0)
        for seed in (1, 2)
        for curvature, worst in ((0.0, 1e-9), (0.02, 3e-9))
    )
    row = Comparison(trials, 1e-9, 0.01, 0.01, (0.01,)).rows()["bounded"]
    assert row.p50 == pytest.approx(2e-9)
    assert row.rms_share == pytest.approx(2e-9 / (0.02 * 0.01**2 / 2))


def test_the_same_seed_gives_the_same_figures_whatever_else_is_compared(comparison: Comparison) -> None:
    options, steps = replace(OPTIONS, methods=("bounded",)), list[str]()
    first = [trial for trial in comparison.trials if trial.method == "bounded"]
    again = compare(options, steps.append).trials
    assert [t.max_zernike for t in first] == [t.max_zernike for t in again]
    assert [t.curvature for t in first] == [t.curvature for t in again]
    assert len(steps) == total_steps(options)


def test_progress_counts_all_steps(comparison: Comparison, steps: list[str]) -> None:
    assert len(steps) == total_steps(OPTIONS)
    assert steps[-1] == f"seed 3: {comparison.trials[-1].method}, closed loop"


def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(command)
    path = tmp_path / "figures.json"
    arguments = [
        "--plant",
        "preisach",
        "--seed",
        "2",
        "--seed",
        "3",
        "--method",
        "bounded",
        "--pixels",
        "100",
        "--creep",
        "0.03",
    ]
    result = CliRunner().invoke(app, [*arguments, "--json", str(path)])
    assert result.exit_code == 0, result.output
    figures = json.loads(path.read_text())
    assert figures["plant"] == "preisach"
    assert figures["seeds"] == [2, 3]
    assert figures["creep_foreseen"] == pytest.approx([0.03, 0.03], rel=0.1)  # from the maps
    assert figures["fitting_limit_nm"] > 0
    assert set(figures["methods"]) == {"bounded", "bounded" + CLOSED}
    for row in figures["methods"].values():
        assert set(row) == {"p50_nm", "p90_nm", "rms_pct_pv", "maps", "seconds"}
        assert all(np.isfinite(value) for value in row.values())


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"seeds": ()}, "at least one"),
        ({"seeds": (1, 1)}, "name each seed once"),
        ({"seeds": (-1,)}, "must not be negative"),
        ({"curvatures": (0.0,)}, "at least one other than 0"),
    ],
)
def test_bad_options_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CompareOptions(**fields)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="must be one of"):
        CompareOptions(methods=("SVD",))
    assert LoopOptions().max_maps > 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "SVD"], "method = 'SVD': unknown; must be one of pseudo_inverse,"),
        (["--seed", "1", "--seed", "1"], "name each seed once"),
        (["--creep", "nan"], "'--creep'"),
        (["--pixels", "10"], "'--pixels'"),
        (["--quick"], "--quick: without effect"),
        (["--mirrors", "1", "--autofocus", "2"], "--autofocus: without effect"),
        (["--hysteresis", "--mirrors", "1"], "--mirrors: without effect"),
        (["--hysteresis", "--max-maps", "2"], "--max-maps: without effect"),
        (["--mirrors", "1", "--creep", "0"], "--creep: without effect with --mirrors"),
        (["--autofocus", "1", "--quick"], "--quick: without effect"),
    ],
)
def test_the_command_refuses_before_it_begins(arguments: list[str], words: str) -> None:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code != 0
    assert words in f"{result.output} {result.exception}"
