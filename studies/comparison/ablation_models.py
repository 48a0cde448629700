"""The models of the ablation, from linear to recipes, each fitted to the maps of one calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import fit_effective
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, fit_hysteresis
from dm_calibration.influence.fit import FitOptions
from dm_common.recipes import NO_RECIPES, RecipeBook
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_tools.running_suite import CURVATURES
from studies.comparison.driven_mirror import build_recipes
from studies.comparison.simulated_bench import SimulatedBench, influence_model

#: `plays only` is the whole law, but chosen among candidates without the Duhem operator.
LINEAR, PLAYS, HYSTERESIS, CREEP, RECIPES = "linear", "plays only", "+ hysteresis", "+ creep", "+ recipes"
MODELS = (LINEAR, PLAYS, HYSTERESIS, CREEP, RECIPES)


@dataclass(frozen=True, eq=False)
class Variant:
    """A model of the mirror, whether it corrects shapes while they are held, and the recipes that it uses, if any."""

    name: str
    loop: Planner
    holds: bool
    book: RecipeBook = NO_RECIPES


def make_variants(bench: SimulatedBench, calibration: Calibration) -> tuple[Variant, ...]:
    """The models, each fitted to the maps of `calibration` alone.

    Raises:
        ValueError: a recipe is beyond the mirror's reach.
    """
    hysteresis = calibration.hysteresis
    assert hysteresis is not None
    plays = fit_hysteresis(calibration.maps, candidates=[c for c in CANDIDATES if not c.slopes])
    still = replace(hysteresis, law=replace(hysteresis.law, creep_rate=0.0))
    whole = _variant(CREEP, bench, calibration, hysteresis, True)
    book, unreachable = build_recipes(bench.fork(), whole.loop, CURVATURES)
    if unreachable:
        raise ValueError(unreachable[0])
    return (
        _variant(LINEAR, bench, calibration, None, False),
        _variant(PLAYS, bench, calibration, plays, True),
        _variant(HYSTERESIS, bench, calibration, still, False),
        whole,
        replace(whole, name=RECIPES, book=book),
    )


def _variant(
    name: str, bench: SimulatedBench, calibration: Calibration, hysteresis: HysteresisFit | None, holds: bool
) -> Variant:
    fit = fit_effective(calibration.maps, hysteresis, FitOptions(), bench.mirror)
    mirror = CalibratedMirror(influence_model(fit, calibration.aperture_radius), bench.limits)
    if hysteresis is None:
        return Variant(name, Planner(mirror, slew_rate=bench.slew_rate), holds)
    # The held-out maps did not test a law without creep: then the figure of its influence function counts.
    held_out = hysteresis.held_out_max_zernike if hysteresis.law.creep_rate else fit.held_out_max_zernike
    figures = HysteresisFigures(hysteresis.law, held_out, hysteresis.unknown_sigma)
    return Variant(name, Planner(mirror, figures, bench.slew_rate), holds)
