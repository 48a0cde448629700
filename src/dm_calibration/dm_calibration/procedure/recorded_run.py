"""A calibration made again from a recording: the same procedure on a bench that answers from what was recorded.

A recording holds what the driver reported and what the interferometer published, but not the goal. The plan follows
from what was commanded: a plan is a function of few options, and only the right ones give the recorded commands to the
last bit. Knows no ROS.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dm_calibration.hysteresis.excitation import MAPS_MAX, MAPS_MIN, REPEATS
from dm_calibration.influence.surfaces import LinearModel
from dm_calibration.procedure.plan import HYSTERESIS_REFERENCE_EVERY, Plan, PlanKind, PlanOptions, StepKind, make_plan
from dm_calibration.procedure.procedure import Outcome, Procedure, ProcedureOptions
from dm_common import Floats
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.names import UnknownNameError

#: Longest distance between reference frames that is tried.
REFERENCE_EVERY_MAX = 200


class RecordingError(ValueError):
    """The recording does not hold a run, or not the whole of it; the message says what is missing."""


@dataclass(frozen=True, eq=False)
class Move:
    """One move that the driver completed.

    Attributes:
        stamp_ns: when its end was written to the electronics.
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
        labels: of the steps that feedback told of, by step.
        model: of the calibration in use when it began; None = none.
    """

    mirror: Mirror
    moves: tuple[Move, ...]
    maps: tuple[Measurement, ...]
    labels: Mapping[int, str]
    steps: int
    model: LinearModel | None = None


class RecordedBench:
    """Answers as the bench did; implements :class:`dm_common.measurement.Bench`."""

    def __init__(self, run: RecordedRun) -> None:
        self._moves, self._maps = run.moves, run.maps
        self._next_move = 0
        self._window = (0, 0)
        self._taken = 0

    def degauss(self) -> None:
        """Pass the next degauss.

        Raises:
            RecordingError: there is none.
        """
        for index in range(self._next_move, len(self._moves)):
            if self._moves[index].degauss:
                self._next_move = index + 1
                return
        raise RecordingError("the recording ends before the degauss that the run began with")

    def apply(self, signals: Floats) -> Floats:
        """What was written when `signals` were commanded.

        Raises:
            RecordingError: they were not.
        """
        for index in range(self._next_move, len(self._moves)):
            move = self._moves[index]
            if not move.degauss and np.array_equal(move.requested, signals):
                self._next_move = index + 1
                later = self._moves[index + 1 :]
                self._window = (move.stamp_ns, later[0].stamp_ns if later else np.iinfo(np.int64).max)
                self._taken = 0
                return move.applied
        raise RecordingError(
            f"a command of the run is not among the {len(self._moves) - self._next_move} recorded moves left: "
            "the recording began late, ended early, or lost messages"
        )

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        """Nothing to wait for."""
        return True

    def measure(self, label: str) -> Measurement:
        """The next map between this move and the next.

        Raises:
            MeasurementError: there is none, as when it was dropped live.
        """
        begin, end = self._window
        found = [measured for measured in self._maps if begin <= measured.stamp_ns < end]
        if self._taken >= len(found):
            raise MeasurementError(ErrorCode.MAP_REJECTED, "no further map was recorded in this state")
        self._taken += 1
        return replace(found[self._taken - 1], moved_ns=begin)


def maps_per_state(run: RecordedRun) -> int:
    """Maps in a state, as most states have them."""
    stamps = np.array([move.stamp_ns for move in run.moves])
    of_state = np.searchsorted(stamps, [measured.stamp_ns for measured in run.maps], side="right")
    counts = np.bincount(of_state, minlength=1)[1:]
    return int(np.median(counts[counts > 0])) if (counts > 0).any() else 1


def find_plan(run: RecordedRun, configured: PlanOptions | None = None) -> Plan:
    """The plan that gives the recorded commands.

    Args:
        configured: options of the node, tried first.

    Raises:
        RecordingError: no plan does.
    """
    furthest, mismatch = -1, "no plan has that many steps"
    for kind, options in _candidates(run, configured or PlanOptions()):
        try:
            plan = make_plan(kind, run.mirror, options)
        except (ValueError, UnknownNameError):
            continue
        if len(plan.steps) != run.steps or any(
            plan.steps[step].label != label for step, label in run.labels.items() if step < len(plan.steps)
        ):
            continue
        agreeing, reason = _agreement(plan, run.moves)
        if not reason:
            return plan
        if agreeing > furthest:
            furthest, mismatch = agreeing, reason
    raise RecordingError(f"no plan of {run.steps} steps gives the recorded commands: {mismatch}")


def _candidates(run: RecordedRun, configured: PlanOptions) -> Iterator[tuple[PlanKind, PlanOptions]]:
    """Kinds and options that could have given the labels and the number of steps."""
    labels = list(run.labels.values())
    degauss = "degauss" in labels
    if any(label.startswith((StepKind.EXCITATION.value, StepKind.CHECK.value, "rest")) for label in labels):
        for maps in range(MAPS_MIN, MAPS_MAX + 1):
            if 2 + REPEATS + maps + maps // HYSTERESIS_REFERENCE_EVERY == run.steps:
                # In one part, or in those after which it may end.
                yield from ((PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=maps, until=m)) for m in (0.0, 1.0))
        return
    surfaces = tuple(label for label in labels if label[0] == "p" and not label.startswith("poke"))
    if any(label.startswith("poke") for label in labels):
        kind = PlanKind.FULL if surfaces else PlanKind.POKES
    else:
        kind = PlanKind.SURFACES
    amplitudes = dict.fromkeys((configured.poke_amplitude, *_poke_amplitudes(run), 1.0))
    spacings = _spacing(run) or list(dict.fromkeys((configured.reference_every, *range(1, REFERENCE_EVERY_MAX + 1))))
    for names in dict.fromkeys(((), surfaces)):
        for every in spacings:
            for amplitude in amplitudes if kind is not PlanKind.SURFACES else (configured.poke_amplitude,):
                yield kind, PlanOptions(amplitude, every, names, degauss)


def _spacing(run: RecordedRun) -> list[int]:
    """Steps between reference frames, from the labels of two of them; none when there are not two."""
    frames = {int(label.split()[1]): step for step, label in run.labels.items() if label.startswith("reference ")}
    numbers = sorted(frames)[:2]
    if len(numbers) < 2:
        return []
    # The last frame may follow sooner, the second does not unless it is the last.
    return [(frames[numbers[1]] - frames[numbers[0]]) // (numbers[1] - numbers[0]) - 1]


def _poke_amplitudes(run: RecordedRun) -> list[float]:
    """Half-swing of the first move that is not at rest."""
    half_range = run.mirror.limits.half_range
    for move in run.moves:
        swing = float(np.abs(move.requested - run.mirror.rest).max()) / half_range
        if not move.degauss and 0.0 < swing <= 1.0:
            return [swing]
    return []


def _agreement(plan: Plan, moves: Sequence[Move]) -> tuple[int, str]:
    """How many steps of `plan` agree with `moves`, and where they differ; "" = nowhere.

    Solved steps agree with any move.
    """
    end = _end(plan, moves)
    for index, (step, move) in enumerate(zip(plan.steps[:end], moves, strict=False)):
        if step.kind is StepKind.DEGAUSS:
            if not move.degauss:
                return index, "the recorded run does not begin with a degauss"
        elif step.signals is not None and not step.needs_model and not np.array_equal(move.requested, step.signals):
            return index, f"step {step.label!r}: other signals were commanded"
    if len(moves) < end:
        return len(moves), f"step {plan.steps[len(moves)].label!r}: the recording ends before it"
    return len(plan.steps), ""


def _end(plan: Plan, moves: Sequence[Move]) -> int:
    """The step before which the run ended: one that was accurate enough there went back to rest and no further."""
    last = len(moves) - 1
    rest = next((step.signals for step in plan.steps if step.kind is StepKind.REFERENCE), None)
    ended = last in plan.ends and rest is not None and np.array_equal(moves[last].requested, rest)
    return last if ended else len(plan.steps)


def repeat_run(
    run: RecordedRun, options: ProcedureOptions | None = None, configured: PlanOptions | None = None
) -> tuple[Plan, Outcome]:
    """The run made again from its recording: its plan and everything measured.

    Raises:
        RecordingError: the recording does not hold the whole run.
        Refusal: as live, when several states in a row gave no map.
    """
    plan = find_plan(run, configured)
    # As live: a full plan solves its shapes on its own pokes.
    model = run.model if plan.kind is PlanKind.SURFACES else None
    end = _end(plan, run.moves)

    def enough(outcome: Outcome) -> bool:
        return outcome.records[-1].step + 1 >= end

    procedure = Procedure(plan, run.mirror, RecordedBench(run), options, model=model, enough=enough)
    return plan, procedure.run()
