"""How good the open loop is on mirrors drawn at random, and whether the bound predicted beforehand holds on each.

Every mirror is calibrated by the plan HYSTERESIS at the limits that ship, and then goes through random requests inside
the range that it publishes; the true surface is judged when each request's dwell ends. The requests reach the same
planner as on the bench, with the calibration read from its message.
"""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_messages import calibration_message, put_updates
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.updates import RecalibrationManager
from dm_common.errors import Refusal
from dm_common.hysteresis.creep_record import CreepRecord
from dm_common.recipes import NO_RECIPES
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.target import FocusTarget
from studies.comparison.drawn_mirrors import DIES, GAIN_STEP, GAIN_STEP_SHARE, DrawnMirror, draw_mirror
from studies.comparison.driven_mirror import DrivenMirror, build_recipes
from studies.comparison.random_requests import (
    CURVATURE_MAX,
    DWELLS,
    REACHABLE_TOLERANCE,
    Requests,
    active_of,
    draw_targets,
    judge_requests,
)
from studies.comparison.simulated_bench import SimulatedBench
from studies.comparison.true_surface import TrueSurface

#: Time for which a shape is held before the electronics are switched off, and time that they stay off, s.
HELD_S, OFF_S = 86400.0, 600.0
#: Numbers of requests after a restart, of maps that then check the calibration, and of requests for each recipe.
FIRST_REQUESTS, CHECK_MAPS, PER_RECIPE = 6, 3, 2

Progress = Callable[[str], None]


@dataclass(frozen=True)
class PopulationOptions:
    """What to run.

    Attributes:
        requests: of each mirror, in any order.
        maps: of each calibration.
        recipes: built for each mirror; 0 = none.
        pixels: of the camera.
    """

    requests: int = 40
    maps: int = 300
    recipes: int = 5
    pixels: int = 236


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results for one mirror.

    Attributes:
        law: name of the law that the calibration found.
        held_out: m, 95th percentile of the largest coefficient error that it predicted.
        curvatures: 1/m, range of spheres that was published.
        groups: requests by what preceded them: ANY_ORDER etc.
        failure: the reason why it could not be judged; "" = it was.
        seconds: processor time of the calibration, and of everything.
    """

    mirror: DrawnMirror
    law: str = ""
    held_out: float = float("nan")
    curvatures: tuple[float, float] = (float("nan"), float("nan"))
    groups: dict[str, Requests] = field(default_factory=dict)
    failure: str = ""
    seconds: tuple[float, float] = (0.0, 0.0)


#: Kinds of requests: from the calibration on; by recipes after a degauss; after a day's hold and a restart; then after
#: maps that checked the calibration; after a power cut during a move.
ANY_ORDER, RECIPES, RESTARTED, CHECKED, POWER_CUT = "any order", "recipes", "restarted", "checked", "power cut"


def held_for_a_day(bench: SimulatedBench, rng: np.random.Generator) -> None:
    """History of some mirrors before their calibration: a shape held for a day, then no power for OFF_S."""
    bench.apply(rng.uniform(-0.5, 0.5) + rng.uniform(-0.4, 0.4, bench.mirror.actuators))
    bench.time += HELD_S
    bench.power_cycle(OFF_S)


def _age(bench: SimulatedBench, mirror: DrawnMirror, rng: np.random.Generator) -> None:
    """Apply the event that happens to the mirror after its calibration."""
    if mirror.event == GAIN_STEP:
        bench.piezo.gain *= 1 + GAIN_STEP_SHARE
    elif mirror.event == DIES:
        bench.piezo.stuck[rng.integers(bench.mirror.actuators)] = True


def _restarted(
    bench: SimulatedBench, active: ActiveCalibration, off: float, record: CreepRecord | None
) -> DrivenMirror:
    """Switch the electronics off for `off` s, restart the suite with the record that it finds on disk, and degauss."""
    bench.power_cycle(off)
    seen = len(bench.reports) - 1
    bench.degauss()
    bench.settle()
    return DrivenMirror(bench, active.planner, seen=seen, record=record)


class _UpdatedCalibration:
    """A calibration updated by every map, as the node `calibration` does with those of checks and of recipes."""

    def __init__(self, bench: SimulatedBench, calibration: Calibration, folder: str) -> None:
        self._bench, self._calibration = bench, calibration
        self._updates = RecalibrationManager(Path(folder), UpdateOptions)
        self._updates.begin(calibration)
        self.take = self._updates.take

    def active(self) -> ActiveCalibration:
        """The calibration with the updates so far."""
        message = calibration_message(self._calibration, None, "mirror", 1.0)
        if (kept := self._updates.in_use) is not None and (kept.drift.revision or kept.drift.surprising):
            put_updates(message, kept, math.nan, [], self._updates.mirror_changed)
        return active_of(self._bench, message)


def judge_mirror(seed: int, options: PopulationOptions, progress: Progress = lambda step: None) -> Outcome:
    """Draw, calibrate and judge one mirror; one that cannot be judged to the end has a failure and no figures."""
    mirror = draw_mirror(seed, options.pixels)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _evaluated(mirror, options, folder, progress)
    except (Refusal, ValueError) as error:
        return Outcome(mirror, failure=str(error))


def _evaluated(mirror: DrawnMirror, options: PopulationOptions, folder: str, progress: Progress) -> Outcome:
    """Calibrate and judge one mirror; the updates of its calibration by later maps are kept in `folder`.

    Raises:
        Refusal, ValueError: it cannot be calibrated, or no request can be drawn, planned or carried out.
    """
    began = time.process_time()
    seed = mirror.simulation.seed
    rng = np.random.default_rng([seed, 15])
    bench = SimulatedBench(mirror.simulation)
    if mirror.held_before:
        held_for_a_day(bench, rng)
    progress(f"seed {seed}: calibration")
    calibration = bench.calibrate(PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=options.maps))
    active = active_of(bench, calibration_message(calibration, None, "mirror", 1.0))
    calibrated = time.process_time() - began
    hysteresis = calibration.hysteresis
    assert hysteresis is not None
    surface = TrueSurface(bench)
    low, high = active.reachable_range(FocusTarget(0.0), REACHABLE_TOLERANCE)
    if not low <= high:
        raise ValueError("no curvature is reachable: the figure takes the whole range")
    groups: dict[str, Requests] = {}
    book, unreachable = NO_RECIPES, list[str]()
    updated = _UpdatedCalibration(bench, calibration, folder)
    if options.recipes:
        progress(f"seed {seed}: recipes")
        curvatures = np.linspace(max(low, -CURVATURE_MAX), min(high, CURVATURE_MAX), options.recipes)
        book, unreachable = build_recipes(bench, active.planner, curvatures, updated.take)
    before, active = active, updated.active()
    _age(bench, mirror, rng)

    progress(f"seed {seed}: any order")
    dwells = rng.permutation(np.resize(DWELLS, options.requests))
    other = bench.fork()
    driven = DrivenMirror(other, active.planner).under(active, before)
    groups[ANY_ORDER] = judge_requests(driven, active, surface, draw_targets(active, options.requests, rng), dwells)
    # From there on, a move that is ended by a power cut.
    progress(f"seed {seed}: power cut")
    first = draw_targets(active, FIRST_REQUESTS + 1, rng)
    short = np.resize(DWELLS[:4], FIRST_REQUESTS)
    record = driven.record()  # the last before the move
    other.power_cut(driven.plan(first[0]).signals, float(rng.uniform(0.1, 0.9)))
    driven = _restarted(other, updated.active(), float(10.0 ** rng.uniform(0, 3.5)), record)
    groups[POWER_CUT] = judge_requests(driven, active, surface, first[1:], short)

    progress(f"seed {seed}: restart")
    other = bench.fork()
    first = draw_targets(active, FIRST_REQUESTS + 1, rng)
    driven = DrivenMirror(other, active.planner)
    driven.hold(driven.go(driven.plan(first[0])), HELD_S)
    before = updated.active()
    driven = _restarted(other, before, OFF_S, driven.record())
    groups[RESTARTED] = judge_requests(driven, active, surface, first[1:], short)
    progress(f"seed {seed}: check maps")
    for target in draw_targets(active, CHECK_MAPS, rng):
        driven.hold(driven.go(driven.plan(target)), other.config.settle_time)
        updated.take(other.measure("check"), driven.settled())
    checked = updated.active()
    first = draw_targets(checked, FIRST_REQUESTS, rng)
    driven = driven.under(checked, before)
    groups[CHECKED] = judge_requests(driven, checked, surface, first, short)

    groups[RECIPES] = Requests.none(unreachable)
    if book.recipes:
        progress(f"seed {seed}: by recipes")
        requested = [recipe.curvature for recipe in book.recipes]
        requested += rng.uniform(requested[0], requested[-1], (PER_RECIPE - 1) * len(requested)).tolist()
        targets = [FocusTarget(float(curvature)) for curvature in rng.permutation(requested)]
        driven = DrivenMirror(bench.fork(), active.planner, book=book)
        result = judge_requests(driven, active, surface, targets, np.resize(DWELLS[:4], len(targets)))
        groups[RECIPES] = replace(result, refusals=(*result.refusals, *unreachable))
    return Outcome(
        mirror,
        hysteresis.name,
        hysteresis.held_out_max_zernike,
        (low, high),
        groups,
        seconds=(calibrated, time.process_time() - began),
    )


def judge_population(
    seeds: Sequence[int], options: PopulationOptions, workers: int = 1, progress: Progress = lambda step: None
) -> Iterator[Outcome]:
    """Judge the mirrors of `seeds`, yielding each when it is done, in order.

    Args:
        workers: processes; 1 = this one.
    """
    if workers == 1:
        for seed in seeds:
            yield judge_mirror(seed, options, progress)
        return
    # Each mirror in a process of its own, so that what one leaves in memory ends with it.
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=1) as pool:
        yield from pool.imap(_judge_one, [(seed, options) for seed in seeds])


def _judge_one(job: tuple[int, PopulationOptions]) -> Outcome:
    return judge_mirror(*job)
