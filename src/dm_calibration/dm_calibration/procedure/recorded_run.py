"""A calibration repeated from a recording: the same procedure on a bench that replays it.

A recording contains the reports of the driver, the maps of the interferometer, and the plan, as part of the action's
feedback. Independent of ROS.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from dm_calibration.influence.surfaces import LinearModel
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import Plan, PlanKind, PlanOptions, StepKind, make_plan
from dm_calibration.procedure.procedure import Procedure, ProcedureOptions
from dm_common import Floats
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror


class RecordingError(ValueError):
    """The recording holds no run, or only a part of one; the message names what is missing."""


@dataclass(frozen=True, eq=False)
class Move:
    """One move that the driver completed.

    Attributes:
        stamp_ns: time at which its last signals were written to the electronics, ns.
        requested, applied: (N,) as the driver reported.
    """

    stamp_ns: int
    requested: Floats
    applied: Floats
    degauss: bool


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """One run of the action `calibrate`.

    Attributes:
        maps: in the order of their stamps.
        plan: as made by :func:`plan_text`.
        model: influence function of the calibration in use when the run began; None = there was none.
    """

    mirror: Mirror
    moves: tuple[Move, ...]
    maps: tuple[Measurement, ...]
    plan: str
    model: LinearModel | None = None


class RecordedBench:
    """Replays a recorded bench, whose moves are those of the plan; implements :class:`dm_common.measurement.Bench`."""

    def __init__(self, run: RecordedRun) -> None:
        self._left, self._maps = list(run.moves), run.maps
        self._found: Iterator[Measurement] = iter(())

    def degauss(self) -> None:
        """Go on to the next move, which is the degauss."""
        self._left.pop(0)

    def apply(self, signals: Floats) -> Floats:
        """The signals that were written when `signals` were commanded.

        Raises:
            RecordingError: `signals` were not commanded.
        """
        if not self._left or not np.array_equal(self._left[0].requested, signals):
            raise RecordingError(
                f"a command of the run matches none of the {len(self._left)} recorded moves left: the recording began "
                "late, ended early, or lost messages"
            )
        move = self._left.pop(0)
        end = self._left[0].stamp_ns if self._left else np.iinfo(np.int64).max
        found = [one for one in self._maps if move.stamp_ns <= one.stamp_ns < end]
        self._found = iter([replace(one, moved_ns=move.stamp_ns) for one in found])
        return move.applied

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        """Return at once: there is nothing to wait for."""
        return True

    def measure(self, label: str) -> Measurement:
        """The next map that was taken between this move and the next one.

        Raises:
            MeasurementError: there is none, for example because it was dropped in the live run.
        """
        if (measured := next(self._found, None)) is None:
            raise MeasurementError(ErrorCode.MAP_REJECTED, "no further map was recorded in this state")
        return measured


def plan_text(plan: PlanKind, options: PlanOptions, maps_per_state: int) -> str:
    """The plan as text in the feedback of a run, from which a recording can be repeated."""
    return json.dumps({"plan": plan, "maps_per_state": maps_per_state, **asdict(options)})


def planned(text: str, mirror: Mirror) -> tuple[Plan, int]:
    """The plan of a run and its number of maps per state, from the text in its feedback.

    Raises:
        RecordingError: the text is of another version.
    """
    try:
        values = json.loads(text)
        kind, count = PlanKind(values.pop("plan")), int(values.pop("maps_per_state"))
        return make_plan(kind, mirror, PlanOptions(**values)), count
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"the recording lacks the plan of the run, or another version made it: {error}") from error


def _difference(plan: Plan, moves: Sequence[Move], end: int) -> str:
    """How `moves` differ from `plan` before the step `end`, as text; "" = not at all. Solved steps match any move."""
    for step, move in zip(plan.steps[:end], moves, strict=False):
        if step.kind is StepKind.DEGAUSS:
            if not move.degauss:
                return f"step {step.label!r}: no degauss was recorded"
        elif step.signals is not None and not step.needs_model and not np.array_equal(move.requested, step.signals):
            return f"step {step.label!r}: other signals were commanded"
    return f"step {plan.steps[len(moves)].label!r}: the recording ends before it" if len(moves) < end else ""


def _end(plan: Plan, moves: Sequence[Move], rest: Floats) -> int:
    """The step before which the run ended: a run that was accurate enough there ended with a move back to `rest`."""
    last = len(moves) - 1
    ended = last in plan.ends and np.array_equal(moves[last].requested, rest)
    return last if ended else len(plan.steps)


def repeat_run(run: RecordedRun, options: ProcedureOptions | None = None) -> tuple[Plan, Outcome]:
    """Repeat the run from its recording; returns its plan and everything measured.

    Raises:
        RecordingError: the recording does not hold the complete run.
        Refusal: as in the live run, if several states in a row gave no map.
    """
    plan, count = planned(run.plan, run.mirror)
    end = _end(plan, run.moves, run.mirror.rest)
    if reason := _difference(plan, run.moves, end):
        raise RecordingError(reason)
    # As in the live run, a full plan solves its shapes with its own pokes.
    model = run.model if plan.kind is PlanKind.SURFACES else None

    def enough(outcome: Outcome) -> bool:
        return outcome.records[-1].step + 1 >= end

    options = replace(options or ProcedureOptions(), maps_per_state=count)
    procedure = Procedure(plan, run.mirror, RecordedBench(run), options, model=model, enough=enough)
    return plan, procedure.run()
