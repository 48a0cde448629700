"""The body of the action `calibrate`: make a plan from the goal, run it, fit, store and publish."""

from collections.abc import Mapping
from typing import Any

from dm_msgs.action import Calibrate
from rclpy.node import Node
from rclpy.parameter import Parameter

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_manager import CalibrationManager
from dm_calibration.calibration_parameters import fit_options, procedure_options
from dm_calibration.calibrator import Provenance, calibrate, check_fit
from dm_calibration.hysteresis.excitation import fewest_maps
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.influence.fit import fit_influence
from dm_calibration.influence.poke_cure import parameter_text, poke_cure
from dm_calibration.procedure.event_frames import Storing
from dm_calibration.procedure.forecast import (
    GoodEnough,
    degauss_time,
    expected_end,
    forecast,
    law_error,
    step_times,
)
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import LAST_PART_ENDS, PlanKind, PlanOptions, StepKind, make_plan
from dm_calibration.procedure.procedure import Procedure, Progress
from dm_calibration.procedure.recorded_run import plan_text
from dm_calibration.procedure.resumable_run import OpenRun, identity_of, mirror_facts, open_run
from dm_calibration.procedure.unfinished_runs import UnfinishedRuns
from dm_common.errors import EXPECTED, Cancelled, ErrorCode, Refusal, error_code
from dm_common.figures import counted
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.worker import WorkerGoal, duration_clock, wait_for_clock
from dm_common.values import fill_with_nan

_OF_HYSTERESIS = (StepKind.EXCITATION, StepKind.IN_USE, StepKind.CHECK, StepKind.DEGAUSSED)
_PHASES = {StepKind.POKE: "pokes", StepKind.SURFACE: "surfaces"} | dict.fromkeys(_OF_HYSTERESIS, "hysteresis")

#: How long a goal waits for a driver that was started together with this node, s.
START_GRACE_S = 5.0


class CalibrateAction:
    """Carries out one goal, in a worker thread."""

    def __init__(
        self,
        node: Node,
        values: Mapping[str, Any],
        services: BenchServices,
        manager: CalibrationManager,
        handle: WorkerGoal,
    ) -> None:
        self._node, self._values, self._services, self._manager = node, values, services, manager
        self._handle, self._goal = handle, handle.request
        self._maps_per_state = self._goal.maps_per_state or 1
        self._result = fill_with_nan(Calibrate.Result())
        self._feedback, self._end = Calibrate.Feedback(), 0

    def run(self) -> tuple[str, Calibrate.Result]:
        """Carry out the goal; return its outcome (succeed, abort or canceled) and the result."""
        goal, result = self._goal, self._result
        clock = duration_clock(self._node.get_clock())
        started = clock.now()
        try:
            self._mirror = self._manager.known_mirror(wait_s=START_GRACE_S)
            wait_for_clock(clock)
            started = clock.now()
            self._make_plan()
            self._forecast()
            if goal.dry_run:
                return "succeed", result
            self._services.check_ready()
            self._services.settle_time = goal.settle_time or self._values["settle_time"]
            self._services.cancelled = lambda: bool(self._handle.is_cancel_requested)
            held = self._services.held(goal, "cancel the action calibrate to end it", result.expected_duration)
            with UnfinishedRuns(self._manager.store.folder) as runs, held:
                self._run_kept(runs)
        except EXPECTED as error:
            result.error_code, result.message = error_code(error), str(error)
        finally:
            self._services.cancelled = lambda: False  # this goal's cancellation must not end waits of other callers
        result.maps_dropped = len(result.dropped)
        result.duration = (clock.now() - started).nanoseconds * 1e-9
        if result.error_code == ErrorCode.OK:
            self._node.get_logger().info(f"{result.id or 'poke check'}: {result.message}")
            return "succeed", result
        self._node.get_logger().warning(f"calibration ended with {ErrorCode(result.error_code).name}: {result.message}")
        return ("canceled" if result.error_code == ErrorCode.CANCELED else "abort"), result

    def _make_plan(self) -> None:
        """Make the plan of the goal, and the options that define it."""
        goal = self._goal
        if goal.until and goal.plan != PlanKind.HYSTERESIS:
            raise Refusal(ErrorCode.INVALID_ARGUMENT, f"until = {goal.until:g} m: only the plan hysteresis ends early")
        default = LAST_PART_ENDS if goal.until else self._values["hysteresis_maps"]
        self._options = PlanOptions(
            poke_amplitude=goal.poke_amplitude or self._values["poke_amplitude"],
            reference_every=goal.reference_every or self._values["reference_every"],
            surfaces=tuple(goal.surfaces),
            degauss=not goal.skip_degauss,
            hysteresis_maps=goal.hysteresis_maps or max(default, fewest_maps(self._mirror.actuators)),
            until=goal.until,
        )
        self._plan = make_plan(PlanKind(goal.plan or PlanKind.FULL), self._mirror, self._options)
        self._end = 0 if goal.until else len(self._plan.steps)

    def _forecast(self) -> None:
        """Fill in the expected duration and accuracy, and the message of a dry run."""
        goal, plan, result = self._goal, self._plan, self._result
        in_use, taken, guessed = self._manager.in_use, self._services.map_time, self._values["map_time"]
        settle_time = goal.settle_time or self._values["settle_time"]
        degauss = degauss_time(self._manager.driver_facts)
        expected = forecast(plan, settle_time, in_use, self._mirror, taken, goal.until, guessed, degauss)
        result.expected_duration, result.expected_max_zernike = expected.duration, expected.max_zernike
        if goal.dry_run:
            maps = expected.maps or sum(step.takes_map for step in plan.steps)
            guess = "" if taken or in_use is not None else f" if a map takes {guessed:g} s (none was taken yet)"
            time_text = f"{maps} maps in about {expected.duration:.0f} s{guess}"
            result.message = f"{time_text}{expected.accuracy(goal.until)}; nothing was moved"

    def _run_kept(self, runs: UnfinishedRuns) -> None:
        """Begin or resume a run, store each map at once, and conclude. Fills the result, even after a failure."""
        result, run = self._result, self._opened(runs)
        self._enough = enough = GoodEnough(
            self._goal.until,
            lambda found: self._report_reached(found, run.outcome.measured),
            self._mirror.limits,
        )
        procedure = self._procedure(run, enough)
        try:
            if run.storing is None:  # else all is measured, and the calibration, which may be stored, must not change
                procedure.run()
            self._report("fit", "fit", self._feedback.steps)
            self._conclude(run, runs, enough)
        except EXPECTED as error:
            result.error_code, result.message = error_code(error), str(error)
            result.maps = result.maps or run.outcome.measured
            result.dropped = result.dropped or list(run.outcome.dropped)
        finally:
            run.journal.close()
            rested = self._services.rest(self._manager.known_mirror().rest)  # the mirror as it is configured now
        kept = ""
        if result.error_code != ErrorCode.OK and run.outcome.records and run.journal.folder.is_dir():
            kept = (
                f"{counted(run.outcome.measured, 'map is', 'maps are')} kept in {run.journal.folder}: the same goal "
                "resumes from there, `./dm calibrate --fresh` begins anew"
            )
        result.message = "; ".join(filter(None, (run.resumed, result.message, kept, rested)))

    def _opened(self, runs: UnfinishedRuns) -> OpenRun:
        in_use, plan = self._manager.in_use, self._plan
        settings = {
            "settle_time_s": self._services.settle_time,
            "maps_per_state": self._maps_per_state,
            "degauss": "over the full range, steps as configured in the driver" if self._options.degauss else "none",
            "model": in_use.id if in_use and plan.kind is PlanKind.SURFACES else "",
        }
        identity = identity_of(plan, self._options, self._mirror, settings, self._manager.driver_facts)
        age_max, fresh = self._values["resume_max_age"], self._values["start_fresh"]
        now_ns = self._node.get_clock().now().nanoseconds
        run = open_run(runs, identity, plan, age_max, fresh, now_ns, self._maps_per_state, self._goal.note)
        if fresh:  # applies to one goal only
            self._node.set_parameters([Parameter("start_fresh", Parameter.Type.BOOL, False)])
        for text in filter(None, (*run.notes, run.resumed)):
            self._node.get_logger().info(text)
        return run

    def _procedure(self, run: OpenRun, enough: GoodEnough) -> Procedure:
        self._feedback.steps = len(self._plan.steps)
        self._feedback.plan = plan_text(self._plan.kind, self._options, self._maps_per_state)
        self._services.publish_waits(self._handle, self._feedback)
        in_use = self._manager.in_use

        def enough_so_far(outcome: Outcome) -> bool:
            phase = self._feedback.phase  # a reference frame after it belongs to this one
            self._report("fit", "fit", self._feedback.step)  # may take minutes
            self._feedback.phase = phase
            return enough(outcome)

        return Procedure(
            self._plan,
            self._mirror,
            self._services,
            procedure_options(self._values, self._maps_per_state),
            # A full plan solves its shapes with the pokes of this run.
            model=in_use.fit if in_use and self._plan.kind is PlanKind.SURFACES else None,
            progress=self._report_progress,
            cancelled=self._services.cancelled,
            outcome=run.outcome,
            keep=run.journal.keep,
            guard=self._guard,
            enough=enough_so_far,
        )

    def _guard(self) -> None:
        """Raise Refusal if the mirror or its limits changed, or the history of the actuators was lost."""
        now, before = self._manager.mirror, self._mirror
        if now is not None and mirror_facts(now) != mirror_facts(before):
            raise Refusal(
                ErrorCode.CALIBRATION_MISMATCH,
                f"the mirror changed in the middle of the run: {now.name} {now.serial!r}, before it was "
                f"{before.name} {before.serial!r} (or its limits did)",
            )
        self._services.check_history()

    def _report(self, phase: str, label: str, step: int) -> None:
        feedback = self._feedback
        feedback.phase, feedback.label, feedback.step = phase, label, step
        left, services = slice(step, self._end), self._services
        feedback.maps_left = sum(each.takes_map for each in self._plan.steps[left])
        degauss, fit = degauss_time(self._manager.driver_facts), self._enough.fit_time
        times = step_times(self._plan, services.settle_time, services.map_time, degauss, fit)
        feedback.time_left = float(times[left].sum())
        self._handle.publish_feedback(feedback)

    def _report_progress(self, now: Progress) -> None:
        self._feedback.maps_dropped, self._feedback.residual_rms = now.dropped, now.residual_rms
        self._feedback.steps, self._end = now.steps, min(self._end, now.steps)
        # Reference frames, and a degauss within a run, belong to the phase around them.
        phase = _PHASES.get(now.kind, self._feedback.phase) if now.done else "degauss"
        self._report(phase, now.label, now.done)

    def _report_reached(self, found: HysteresisFit, maps: int) -> None:
        """Report the error of the law `found` after `maps` maps, and estimate the remaining steps."""
        feedback, reached = self._feedback, found.held_out_max_zernike
        feedback.reached_max_zernike = reached
        law = law_error(self._manager.in_use, self._mirror)
        step, until = feedback.step, self._goal.until
        own = found.law.actuators
        self._end, feedback.expected_max_zernike = expected_end(self._plan, step, reached, until, law, own)
        self._node.get_logger().info(f"{maps} maps: accurate to {reached * 1e9:.2f} nm")

    def _conclude(self, run: OpenRun, runs: UnfinishedRuns, enough: GoodEnough) -> None:
        """Fit, check, store and publish; fills the result. The journal is removed once everything is on disk."""
        goal, mirror, outcome, result = self._goal, self._mirror, run.outcome, self._result
        calibration: Calibration | None = None
        try:
            if self._plan.kind is PlanKind.POKE_CHECK:
                fit = fit_influence(outcome.maps(), fit_options(self._values), rings=mirror.rings)
            else:
                calibration = self._calibration(run)
                fit = calibration.fit
            check = check_fit(fit, mirror)
        except ValueError as error:
            # The same goal would fail again in the same way; the journal is set aside, which keeps its maps.
            run.journal.close()
            raise Refusal(
                error_code(error), f"{error}; the maps are in {runs.set_aside(run.journal.folder)}"
            ) from error
        result.dropped = [*outcome.dropped, *map(": ".join, outcome.maps().rejected(fit.reasons))]
        result.maps = int(fit.used.sum())
        result.in_sample_rms, result.held_out_rms = fit.in_sample_rms, fit.held_out_rms
        result.condition_number = fit.condition_number
        result.poke_check_passed, result.poke_findings = check.passed, list(check.findings)
        changes, beyond = poke_cure(check, mirror, outcome.records[-1], self._manager.driver_facts.get("channels", ()))
        result.parameters = parameter_text(changes)
        result.poke_findings += filter(None, [beyond])
        if calibration is None:
            run.journal.remove()
            if not check.passed:
                raise Refusal(ErrorCode.POKE_CHECK_FAILED, "; ".join(check.findings))
            result.message = f"wiring and orientation are as configured: {check.pose}"
            return
        if (found := calibration.hysteresis) is not None:
            result.hysteresis_model, result.hysteresis_held_out_max_zernike = found.name, found.held_out_max_zernike
        if self._services.cancelled():  # during the fit; the same goal will fit the stored maps again
            raise Cancelled("cancelled")
        self._report("store", calibration.id, self._feedback.steps)
        run.journal.keep(Storing(calibration.id, calibration.created_ns))
        file, calibration = self._manager.keep(calibration)
        result.file = str(file)
        run.journal.remove()
        result.id = calibration.id
        result.warning = self._manager.use(calibration) if goal.activate else ""
        wrong = "" if check.passed else f", poke check: {'; '.join(check.findings)}"
        residuals = f"{fit.in_sample_rms * 1e9:.2f} nm in sample, {fit.held_out_rms * 1e9:.2f} nm held out{wrong}"
        reached = enough.sentence(result.hysteresis_held_out_max_zernike) if goal.until else ""
        result.message = "; ".join(filter(None, (f"{result.maps} maps, residual {residuals}", reached, result.warning)))

    def _calibration(self, run: OpenRun) -> Calibration:
        """The calibration that follows from the maps of the run."""
        state = self._services.state
        unknown = self._goal.skip_degauss and not (state is not None and state.history_known)
        provenance = self._manager.provenance(self._mirror.name, self._mirror.serial, self._goal.note)
        if run.storing is not None:  # the process was killed while storing: keep the id, do not make a second one
            provenance = Provenance(run.storing.id, run.storing.created_ns, provenance.note)
        return calibrate(
            run.outcome,
            mirror=self._mirror,
            options=fit_options(self._values),
            provenance=provenance,
            run_limitations=["Measured from an unknown hysteresis state, without a degauss before."] if unknown else [],
        )
