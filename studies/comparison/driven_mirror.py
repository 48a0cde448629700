"""A simulation driven as the suite drives a mirror: moves, holds against creep, and state estimates from reports."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from contextlib import suppress

from dm_calibration.procedure.applied_history import AppliedHistory, MapNotUsableError, SettledState
from dm_common.hysteresis.creep_record import CreepRecord, record_of
from dm_common.hysteresis.observer import HysteresisTracker
from dm_common.measurement import Measurement
from dm_common.recipes import NO_RECIPES, RecipeBook
from dm_controller.converge.recipe_building import BuildOptions, BuildStep, RecipeBuilder, recipe_book
from dm_controller.creep_hold import PERIOD_S
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import SETTLE_S, Move, Planner
from dm_controller.planning.recipes import Corrections, UnreachableError
from dm_controller.planning.target import FocusTarget
from studies.comparison.simulated_bench import SimulatedBench

#: Wait for the next correction of a held shape, as a share of the time since the move: creep slows down in proportion,
#: and an experiment need not correct more often. The first corrections come at the controller's period.
CORRECTION_GROWTH = 0.07


def build_recipes(
    bench: SimulatedBench,
    planner: Planner,
    curvatures: Iterable[float],
    on_map: Callable[[Measurement, SettledState], object] = lambda measured, settled: None,
) -> tuple[RecipeBook, list[str]]:
    """Recipes of these curvatures, built on the bench in its present state, and the refusals of the other curvatures.

    Args:
        on_map: called with each map, and the effective signals at that time. If it changes the calibration, `by_model`
            of the recipes does not follow.
    """
    tracker, history = HysteresisTracker(planner.law), AppliedHistory()
    history.follow(planner.law)
    for report in bench.reports:
        tracker.observe(report)
    seen = 0

    def on_step(_: BuildStep) -> None:
        nonlocal seen
        for report in bench.reports[seen:]:
            history.observe(report)
        seen = len(bench.reports)
        assert bench.latest is not None
        with suppress(MapNotUsableError):  # the node, too, continues without such a map
            on_map(bench.latest, history.settled(bench.time, 0.0))

    options = BuildOptions(settle_time=bench.config.settle_time)
    builder = RecipeBuilder(planner, bench, lambda: bench.time, options, state=tracker.state, on_step=on_step)
    refusals = []
    for curvature in curvatures:
        try:
            builder.build(FocusTarget(float(curvature)))
        except UnreachableError as error:
            refusals.append(str(error))
    if not builder.recipes:
        return NO_RECIPES, refusals
    return recipe_book(builder.recipes, planner, bench.config.degauss_steps, round(1e9 * bench.time)), refusals


class DrivenMirror:
    """A simulation under one model of it.

    Args:
        holds: whether shapes are corrected while they are held.
        book: recipes to use; each move by a recipe begins with a degauss.
        seen: number of reports of the bench that the suite missed, because it was started only later.
        record: creep record that the previous run of the suite left on disk.
    """

    def __init__(
        self,
        bench: SimulatedBench,
        planner: Planner,
        holds: bool = True,
        book: RecipeBook = NO_RECIPES,
        seen: int = 0,
        record: CreepRecord | None = None,
    ) -> None:
        self.bench = bench
        self._holds, self._book = holds, book
        self._plan_with(planner)
        self._tracker = HysteresisTracker(planner.law, record=record)
        self._seen = seen
        self._follow()

    def _plan_with(self, planner: Planner) -> None:
        self._planner = planner
        self._corrections = Corrections(self._book, planner) if self._book.recipes else None

    def _follow(self) -> None:
        for report in self.bench.reports[self._seen :]:
            self._tracker.observe(report)
        self._seen = len(self.bench.reports)

    def under(self, active: ActiveCalibration, before: ActiveCalibration) -> DrivenMirror:
        """The same mirror from here on with the calibration `active`, which check maps have made of `before`."""
        other = copy.copy(self)
        active.note_creep_shown(before, self._tracker.state)
        other._plan_with(active.planner)
        return other

    def settled(self) -> SettledState:
        """The effective signals now, with which maps are compared."""
        self._follow()
        state, law = self._tracker.state, self._planner.law
        assert state is not None
        return SettledState(law.effective(law.advance(state, self.bench.time)), self.bench.reports[-1].time)

    def record(self) -> CreepRecord | None:
        """The creep record that the suite leaves on disk."""
        self._follow()
        return record_of(self._planner.law, self._tracker.state, self.bench.time)

    def plan(self, target: FocusTarget) -> Move:
        """The move to `target` from the present state; with recipes, the mirror is degaussed first, and one is used."""
        recipe = None
        if self._corrections is not None:
            recipe = self._corrections.find(target)
            self.bench.degauss()
        self._follow()
        state, known = self._tracker.state, not self._tracker.unknown
        return self._planner.plan(target, state, self.bench.time, known, recipe, SETTLE_S)

    def go(self, move: Move) -> Move:
        """Carry out `move`, which holds the prediction made beforehand.

        Raises:
            Refusal: the driver refuses it.
        """
        self.bench.apply(move.plan.signals)
        return move

    def hold(self, move: Move, dwell: float) -> None:
        """Hold the shape of `move` for `dwell` s, with corrections against creep."""
        began = self.bench.time
        passed = PERIOD_S
        while self._holds and passed < dwell:
            self.bench.time = began + passed
            self._follow()
            wait = min(max(PERIOD_S, CORRECTION_GROWTH * passed), dwell - passed)
            state = self._tracker.state
            assert state is not None
            self.bench.apply(self._planner.hold(state, self.bench.time, move.effective, 0.5 * wait))
            passed += wait
        self.bench.time = began + dwell
