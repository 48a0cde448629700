"""The models of the ablation, from linear to recipes, each made of the maps of one calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import fit_remembering
from dm_calibration.influence.fit import FitOptions
from dm_calibration.memory.identify import CANDIDATES
from dm_calibration.memory.memory_fit import MemoryFit, fit_memory
from dm_calibration.memory.recipes import NO_RECIPES, RecipeBook
from dm_calibration.memory.tracker import MemoryTracker
from dm_controller.experiments.compare import CURVATURES
from dm_controller.experiments.twin_bench import TwinBench, influence_model
from dm_controller.model import CalibratedMirror
from dm_controller.open_loop import MemoryFigures, OpenLoop
from dm_controller.recipe_building import BuildOptions, RecipeBuilder, recipe_book
from dm_controller.target import FocusTarget

#: `plays only` is the whole law, chosen among candidates without the Duhem operator.
LINEAR, PLAYS, HYSTERESIS, CREEP, RECIPES = "linear", "plays only", "+ hysteresis", "+ creep", "+ recipes"
MODELS = (LINEAR, PLAYS, HYSTERESIS, CREEP, RECIPES)


@dataclass(frozen=True, eq=False)
class Variant:
    """A model of the mirror, whether it corrects shapes while they are held, and its recipes, if it goes by them."""

    name: str
    loop: OpenLoop
    holds: bool
    book: RecipeBook = NO_RECIPES


def make_variants(bench: TwinBench, calibration: Calibration) -> tuple[Variant, ...]:
    """The models, each made of the maps of `calibration` alone."""
    memory = calibration.memory
    assert memory is not None
    plays = fit_memory(calibration.maps, candidates=[c for c in CANDIDATES if not c.slopes])
    still = replace(memory, law=replace(memory.law, creep_rate=0.0))
    whole = _variant(CREEP, bench, calibration, memory, True)
    return (
        _variant(LINEAR, bench, calibration, None, False),
        _variant(PLAYS, bench, calibration, plays, True),
        _variant(HYSTERESIS, bench, calibration, still, False),
        whole,
        replace(whole, name=RECIPES, book=_recipes(bench.fork(), whole.loop)),
    )


def _recipes(bench: TwinBench, loop: OpenLoop) -> RecipeBook:
    """Recipes over the range of the requests, built on the bench as it stands."""
    tracker = MemoryTracker(loop.law)
    for report in bench.reports:
        tracker.observe(report)
    options = BuildOptions(settle_time=bench.config.settle_time)
    builder = RecipeBuilder(loop, bench, lambda: bench.time, options, state=tracker.state)
    recipes = [builder.build(FocusTarget(c)) for c in CURVATURES]
    return recipe_book(recipes, loop, bench.config.degauss_steps, round(1e9 * bench.time))


def _variant(name: str, bench: TwinBench, calibration: Calibration, memory: MemoryFit | None, holds: bool) -> Variant:
    fit = fit_remembering(calibration.maps, memory, FitOptions(), bench.mirror)
    mirror = CalibratedMirror(influence_model(fit, calibration.aperture_radius), bench.limits)
    if memory is None:
        return Variant(name, OpenLoop(mirror, slew_rate=bench.slew_rate), holds)
    # A law without creep was not what the held-out maps tested: then its influence function's own figure counts.
    held_out = memory.held_out_max_zernike if memory.law.creep_rate else fit.held_out_max_zernike
    figures = MemoryFigures(memory.law, memory.zernike_sigma, held_out, memory.unknown_sigma)
    return Variant(name, OpenLoop(mirror, figures, bench.slew_rate), holds)
