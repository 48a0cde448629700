"""The calibration procedure: follow a plan, command, settle, measure, and lose no good map because of a bad one.

It is independent of ROS: mirror and instrument are a `dm_common.measurement.Bench`. An interrupted run continues with a
degauss, since the history of the actuators is no longer known, and with a reference frame.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.surfaces import LinearModel, model_surface
from dm_calibration.procedure.bump_check import BumpCheck, BumpOptions
from dm_calibration.procedure.map_comparison import check_comparable, check_not_earlier
from dm_calibration.procedure.outcome import (
    Doubted,
    Dropped,
    Event,
    MapTaken,
    Outcome,
    Segment,
    Solved,
    without_map,
)
from dm_calibration.procedure.plan import Plan, PlanKind, Step, StepKind, shape_in_use
from dm_common import Floats
from dm_common.errors import Cancelled, ErrorCode, MeasurementError, Refusal
from dm_common.figures import counted
from dm_common.measurement import Bench, Measurement
from dm_common.mirror import APERTURE_TOLERANCE, Mirror
from dm_common.values import live_parameter, whole

#: Maps of the mirror at rest when a hysteresis run is resumed: they show the present figure.
RESUME_MAPS = 3


@dataclass(frozen=True)
class ProcedureOptions:
    """Retries and checks of the measurements.

    Attributes:
        aperture_tolerance: largest relative deviation of a map's aperture radius from the mirror's.
        fit: options of the fit from which surfaces with a prescribed shape are solved.
        bump: largest differences between reference frames.
    """

    measure_retries: int = live_parameter(whole(1, 0, 20), "Further tries after a map that failed.")
    failures_max: int = live_parameter(
        whole(3, 1, 1000), "Number of shapes in a row without a map after which a run is given up."
    )
    maps_per_state: int = 1
    aperture_tolerance: float = APERTURE_TOLERANCE
    fit: FitOptions = field(default_factory=FitOptions)
    bump: BumpOptions = field(default_factory=BumpOptions)


@dataclass(frozen=True)
class Progress:
    """Progress of the procedure: `done` of `steps` steps are done; if it ends early, `steps` are those until then."""

    label: str
    kind: StepKind
    done: int
    steps: int
    dropped: int
    residual_rms: float


class Procedure:
    """One run of a plan on a bench. `outcome` can be read at any time, even after a failure."""

    def __init__(
        self,
        plan: Plan,
        mirror: Mirror,
        bench: Bench,
        options: ProcedureOptions | None = None,
        *,
        model: LinearModel | None = None,
        progress: Callable[[Progress], None] = lambda progress: None,
        cancelled: Callable[[], bool] = lambda: False,
        outcome: Outcome | None = None,
        keep: Callable[[Event], None] = lambda event: None,
        guard: Callable[[], None] = lambda: None,
        enough: Callable[[Outcome], bool] = lambda outcome: False,
    ) -> None:
        """Prepare a run.

        Args:
            model: for solving the surfaces with a prescribed shape; None = fit one to the maps of this run before the
                first such surface.
            outcome: of an interrupted run of the same plan, to be continued; None = begin a new run.
            keep: called with each event before it takes effect; an exception ends the run.
            guard: called before each step; an exception ends the run.
            enough: called at the steps where the plan may end; True ends the run.
        """
        self.outcome = outcome or Outcome(remarks=list(plan.remarks))
        self._plan, self._mirror, self._bench = plan, mirror, bench
        self._steps = len(plan.steps)  # fewer once enough are done
        self._options = options or ProcedureOptions()
        self._model = model
        self._models: dict[StepKind, LinearModel] = {}
        self._progress, self._keep = progress, keep
        self._cancelled, self._guard = cancelled, guard
        self._failures = 0
        self._enough = enough
        self._bump = BumpCheck(self._options.bump, mirror, self._options.fit.hysteresis_allowance)
        for record in self.outcome.records:
            self._bump.take(record)
        self._interrupted = False  # degaussed after an interruption, perhaps also realigned, since the last map

    def run(self) -> Outcome:
        """Go through all steps that are not done yet.

        The caller returns the mirror to rest afterwards, however this ends.

        Raises:
            Cancelled: `cancelled()` became true, which is noticed within one step.
            Refusal: the mirror failed, the interferometer gave no map for several states in a row, or the mirror
                was bumped.
        """
        steps = self._plan.steps
        todo = [number for number, step in enumerate(steps) if not self._is_done(number, step)]
        if todo and self.outcome.records:
            self._go_on(todo[0])
        for number, planned in enumerate(steps):
            if self._is_done(number, planned):
                continue
            if number in self._plan.ends and self._enough(self.outcome):
                self._steps = number
                break
            self._do(planned, number)
        last = steps[self._steps - 1]
        self._report(last.label, last.kind, self._steps)
        return self.outcome

    def _is_done(self, number: int, step: Step) -> bool:
        if step.kind is StepKind.DEGAUSS:
            return self._is_done(number + 1, self._plan.steps[number + 1])
        return self.outcome.tried(number) >= self._options.maps_per_state

    def _do(self, planned: Step, number: int) -> None:
        self._checkpoint()
        self._report(planned.label, planned.kind, number)
        if planned.kind is StepKind.DEGAUSS:
            self._bench.degauss()
            self._bump.degaussed()
            if not self.outcome.records:
                self._note(Segment(0, time.time_ns()))
        elif (step := self._solved(planned, number)) is not None:
            self._measure_state(step, number, self._options.maps_per_state)

    def _go_on(self, done: int) -> None:
        """Begin a new segment after an interruption: degauss, then a map of the mirror at rest."""
        self._checkpoint()
        if self._plan.steps[0].kind is StepKind.DEGAUSS:
            self._report(f"degauss (resumed after {self.outcome.records[-1].label})", StepKind.DEGAUSS, done)
            self._bench.degauss()
        self._note(Segment(self.outcome.segment + 1, time.time_ns()))
        self._bump.degaussed()
        self._interrupted = True
        step = Step(f"reference resumed {self.outcome.segment}", StepKind.REFERENCE, self._mirror.rest)
        self._report(step.label, step.kind, done)
        repeats = max(self._options.maps_per_state, RESUME_MAPS if self._plan.kind is PlanKind.HYSTERESIS else 1)
        self._measure_state(step, len(self._plan.steps) + self.outcome.segment, repeats)
        if self._failures:
            raise Refusal(ErrorCode.MAP_REJECTED, f"{step.label} gave no map, without which the run cannot go on")

    def _report(self, label: str, kind: StepKind, done: int) -> None:
        residual_rms = self.outcome.records[-1].residual_rms if self.outcome.records else 0.0
        self._progress(Progress(label, kind, done, self._steps, len(self.outcome.dropped), residual_rms))

    def _checkpoint(self) -> None:
        if self._cancelled():
            raise Cancelled("cancelled")
        self._guard()

    def _note(self, event: Event) -> None:
        """Write the event to disk before it takes effect, so that nothing that counts can get lost."""
        self._keep(event)
        self.outcome.take(event)

    def _solved(self, step: Step, number: int) -> Step | None:
        """`step` with its signals; None, with the reason in `dropped`, if there is no model to solve them with."""
        if not step.needs_model:
            return step
        try:
            model = self._model or self._models.get(step.kind)
            if model is None:
                maps = self.outcome.maps_before_solving(step.kind)
                model = self._models[step.kind] = fit_influence(maps, self._options.fit, rings=self._mirror.rings)
            if step.in_use:
                return shape_in_use(step, model, self._mirror)
            surface = model_surface(step.label, model, self._mirror)
        except TooFewMapsError as error:
            if step.in_use:
                return step
            reason = f"{step.label}: its signals need an influence function, which the maps do not give yet: {error}"
            self._note(Dropped(number, reason, whole=True))
            return None
        self._note(Solved(surface.target, surface.remark))
        return replace(step, signals=surface.signals, nominal=surface.nominal)

    def _measure_state(self, step: Step, number: int, repeats: int) -> None:
        assert step.signals is not None
        applied = self._bench.apply(step.signals)
        self._bump.moved(applied)
        if not self._bench.settle(step.dwell, step.settle_share):
            raise Cancelled("cancelled while settling")
        taken = 0
        failure = MeasurementError(ErrorCode.MAP_REJECTED, "")
        one = step
        for repeat in range(self.outcome.tried(number), repeats):
            one = replace(step, label=f"{step.label} ({repeat + 1})") if repeat else step
            try:
                self._take(one, number, applied)
                taken += 1
            except MeasurementError as error:
                self._note(Dropped(number, f"{one.label}: {error}"))
                failure = error
        if not taken:
            self._note_unseen(one, number, applied)
        self._failures = 0 if taken else self._failures + 1
        if self._failures >= self._options.failures_max:
            raise Refusal(failure.error_code, f"{self._failures} states in a row gave no map; the last: {failure}")

    def _take(self, step: Step, number: int, applied: Floats) -> None:
        """Take a map of the present state, the signals `applied` (N,); `number`: of the state in the run.

        Raises MeasurementError if every try failed, Refusal if two reference frames show that the mirror was bumped.
        """
        for attempt in range(self._options.measure_retries + 1):
            self._checkpoint()
            try:
                taken = self._map(step, number, applied)
                break
            except MeasurementError as error:
                if attempt == self._options.measure_retries:
                    tries = f" ({attempt + 1} tries)" if attempt else ""
                    raise MeasurementError(error.error_code, f"{error}{tries}") from error
        if step.kind is StepKind.REFERENCE and self._bump.change(taken, self._interrupted):
            taken = self._map(step, number, applied)  # a bad map or a moved mirror: a second map decides
            if suspicion := self._bump.change(taken, self._interrupted):
                self._stop_bumped(step.label, suspicion)
        self._note(MapTaken(taken))
        self._bump.take(taken)
        self._interrupted = False

    def _stop_bumped(self, label: str, suspicion: str) -> None:
        """End the run; the maps since the last good reference frame are in doubt."""
        if self._interrupted:
            raise Refusal(
                ErrorCode.MAP_REJECTED,
                f"{label}: {suspicion}: the mirror is not where it was before the run was interrupted. Put it back, "
                "or begin anew (`./dm calibrate --fresh`)",
            )
        records = self.outcome.records
        kept = max(index for index, record in enumerate(records, 1) if record.kind == StepKind.REFERENCE)
        since = counted(sum(record.has_map for record in records[kept:]), "map since is", "maps since are")
        self._note(Doubted(kept, f"in doubt, bumped before {label}"))
        raise Refusal(
            ErrorCode.MAP_REJECTED,
            f"{label}: {suspicion}: the mirror or the interferometer was bumped, and {since} in "
            "doubt; put the mirror back and start again to go on from the last good reference frame",
        )

    def _map(self, step: Step, number: int, applied: Floats) -> Measurement:
        """Take a map that is comparable with the others."""
        measured = self._bench.measure(step.label)
        self._guard()
        check_comparable(measured, self.outcome, self._mirror.working_radius, self._options.aperture_tolerance)
        if self._plan.kind is PlanKind.HYSTERESIS:
            check_not_earlier(measured, self.outcome)
        if self.outcome.setup is None:
            self._note(measured.setup)
        assert step.signals is not None
        return replace(
            measured,
            label=step.label,
            kind=step.kind.value,
            step=number,
            signals=step.signals,
            applied=applied,
            nominal=step.nominal,
            segment=self.outcome.segment,
        )

    def _note_unseen(self, step: Step, number: int, applied: Floats) -> None:
        """If hysteresis is to be identified, keep a command without a map: it is part of the actuators' history.

        Its time is not known; it is set to that of the map before.
        """
        records = self.outcome.records
        if self._plan.kind is not PlanKind.HYSTERESIS or not records:
            return
        # A reference frame without a map becomes an ordinary command: it helps neither the figure nor the bump check.
        kind = StepKind.EXCITATION if step.kind is StepKind.REFERENCE else step.kind
        changed = {"label": step.label, "kind": kind.value, "step": number, "signals": step.signals, "applied": applied}
        self._note(without_map(records[-1], **changed))
