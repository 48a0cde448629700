"""The ablation on a small simulation: every part of the model earns its place, and the figures are what they say."""

from __future__ import annotations

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_controller.planning.target import FocusTarget
from studies.comparison import ablation_models
from studies.comparison.ablation import CONDITIONED, HISTORIES, AblationOptions, ablate, total_steps
from studies.comparison.ablation_figures import Ablation, Requests, RowFigures, figures_of
from studies.comparison.ablation_models import CREEP, HYSTERESIS, LINEAR, MODELS, PLAYS, RECIPES
from studies.comparison.compare import fitting_limits, true_error
from studies.comparison.random_requests import DWELLS
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig
from studies.comparison.true_surface import TrueSurface
from studies.verbs.compare import compare as command
from studies.verbs.compare_hysteresis import rows_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("common_laws")]

WAVELENGTH = 632.8e-9
#: Tried by `common_laws`: that of the simulation, and the best one without a fading operator.
TRIED_LAWS = ("linear", "Preisach", "Duhem")
SMALL = SimulationConfig(pixels=120, degauss_steps=50)
OPTIONS = AblationOptions(SMALL, ("bouc_wen",), (3,), requests=10, maps=120)


@pytest.fixture(scope="module")
def ablation() -> Ablation:
    steps: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        # As `common_laws`, for the model without fading hysteresis.
        patch.setattr(ablation_models, "CANDIDATES", [law for law in COMMON if law.name in TRIED_LAWS])
        result = ablate(OPTIONS, steps.append)
    assert len(steps) == total_steps(OPTIONS)
    return result


def pooled(ablation: Ablation, model: str) -> RowFigures:
    return figures_of(Requests.pooled(s.requests for s in ablation.series if s.model == model), ablation.radius)


def test_each_part_helps(ablation: Ablation) -> None:
    p50 = {model: pooled(ablation, model).p50 for model in MODELS}
    assert p50[LINEAR] > 3.0 * p50[HYSTERESIS] > 12.0 * p50[CREEP]
    assert p50[PLAYS] > 5.0 * p50[CREEP]
    assert max(p50[CREEP], p50[RECIPES]) < WAVELENGTH / 200


def test_a_held_shape_stays(ablation: Ablation) -> None:
    drift = {(s.model, s.history): s.hold_1h.max() for s in ablation.series}
    for history in HISTORIES:
        assert drift[CREEP, history] < WAVELENGTH / 200 < drift[LINEAR, history]


def test_rows_are_complete(ablation: Ablation) -> None:
    rows = rows_of(ablation)
    assert {(row["model"], row["history"]) for row in rows} == {
        *((model, history) for model in MODELS[:-1] for history in HISTORIES),
        (RECIPES, CONDITIONED),
    }
    assert {row["dwell_s"] for row in rows} == {None, *DWELLS}
    assert all(row["requests"] == (10 if row["dwell_s"] is None else 2) for row in rows)
    assert all(0.0 <= row["bound_coverage"] <= 1.0 for row in rows)


def test_many_surfaces_at_once_are_judged_like_one() -> None:
    bench = SimulatedBench(SMALL)
    surface = TrueSurface(bench)
    targets = [FocusTarget(0.01), FocusTarget(-0.03)]
    displacements = []
    for signals, target in zip((np.linspace(-0.5, 0.5, 37), np.full(37, 0.3)), targets, strict=True):
        bench.apply(signals)
        bench.settle()
        displacements.append(bench.true_displacement)
        last = true_error(bench, target)
    errors, rms = surface.errors(np.array(displacements), targets)
    assert np.abs(errors[-1]).max() == pytest.approx(last.max_zernike, rel=1e-6)
    assert rms[-1] == pytest.approx(last.rms, rel=1e-6)
    limits = fitting_limits(bench, [target.curvature for target in targets])
    np.testing.assert_allclose(surface.limits(targets), limits, rtol=1e-5)


def test_a_power_cycle_makes_the_history_unknown() -> None:
    bench = SimulatedBench(SMALL)
    bench.degauss()
    assert bench.reports[-1].history_known
    bench.power_cycle(60.0)
    last = bench.reports[-1]
    assert (last.turns, last.degausses, last.history_known) == (0, 0, False)
    np.testing.assert_allclose(last.signals, -1.0, atol=1e-3)


def test_options_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="requests = 2"):
        AblationOptions(requests=2)
    with pytest.raises(ValueError, match="history = 'magic'"):
        AblationOptions(histories=("magic",))


def test_the_command_refuses_all_plants_without_hysteresis() -> None:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, ["--plant", "all"])
    assert result.exit_code == 2
    assert "--hysteresis" in result.output
