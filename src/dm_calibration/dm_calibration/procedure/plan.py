"""The steps of a calibration, in order: degauss, reference frames, pokes, surfaces of Table 1, hysteresis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from dm_calibration.hysteresis.excitation import MAPS_MAX, MAPS_MIN, REPEATS, excitation, fewest_maps, next_part
from dm_calibration.influence import surfaces
from dm_calibration.influence.maps import StepKind
from dm_common import Floats
from dm_common.limits import SLACK
from dm_common.mirror import Mirror
from dm_common.values import live_parameter, real, whole

#: Commands between two reference frames of a hysteresis plan; few suffice, as most of the drift is modelled as creep.
HYSTERESIS_REFERENCE_EVERY = 100
#: A run with `until` may end as soon as there are enough commands to find a law, and then whenever their number has
#: grown by the share NEXT_PART, in multiples of PART_STEP. Each part has its own check moves.
NEXT_PART, PART_STEP = 0.25, 20
#: Number of commands after which such a run ends in any case, unless the goal gives another number.
LAST_PART_ENDS = 420
#: Share of the neighbour limit that in-use shapes may take up, below 1 to leave room for rounding.
IN_USE_ROOM = 0.999
#: A mirror counts as one-sided if it is flat further from mid range than this share of the half range.
ONE_SIDED = 0.5


class PlanKind(StrEnum):
    """The kinds of plans; the values are those in dm_msgs/Calibrate."""

    FULL = "full"
    POKES = "pokes"
    SURFACES = "surfaces"
    POKE_CHECK = "poke_check"
    HYSTERESIS = "hysteresis"


@dataclass(frozen=True)
class Step:
    """One step of a plan. A degauss is followed by a map of the mirror at rest.

    Attributes:
        label: unique in the plan.
        signals: (N,) to command; None for a degauss, and for a surface that is solved just before it is measured. For
            an in-use shape: signals that would make it if the figure were flat, see :func:`shape_in_use`.
        nominal: (21,) coefficients aimed at, m; None when signals are prescribed.
        dwell: time to hold the shape beyond the settle time, s.
    """

    label: str
    kind: StepKind
    signals: Floats | None = None
    nominal: Floats | None = None
    dwell: float = 0.0
    settle_share: float = 1.0

    @property
    def takes_map(self) -> bool:
        """Whether the step ends with a map: all but a degauss do."""
        return self.kind is not StepKind.DEGAUSS

    @property
    def needs_model(self) -> bool:
        """Whether the signals must first be solved with an influence function."""
        return self.in_use or (self.kind is StepKind.SURFACE and self.signals is None)

    @property
    def in_use(self) -> bool:
        """Whether the step makes an in-use shape, see `dm_calibration.hysteresis.excitation`."""
        return self.kind in (StepKind.IN_USE, StepKind.CHECK)


@dataclass(frozen=True)
class PlanOptions:
    """How to measure.

    Attributes:
        surfaces: names of Table 1; empty = all.
        until: accuracy at which a hysteresis plan may end, m; 0 = never before its end.
    """

    poke_amplitude: float = live_parameter(real(0.5, 0.01, 1.0), "Half-swing of a push-pull poke, normalised.")
    reference_every: int = live_parameter(
        whole(10, 1, 1000),
        "Steps between two reference frames in runs of pokes and surfaces; hysteresis runs have one every 100.",
    )
    surfaces: Sequence[str] = ()
    degauss: bool = True
    hysteresis_maps: int = live_parameter(
        whole(300, MAPS_MIN, MAPS_MAX),
        "Commands of a hysteresis plan, at least two for each actuator; more of them reduce the noise.",
    )
    until: float = 0.0


@dataclass(frozen=True)
class Plan:
    """The steps in order, deviations from the request, and the steps before which the run may end."""

    kind: PlanKind
    steps: tuple[Step, ...]
    remarks: tuple[str, ...] = ()
    ends: frozenset[int] = frozenset()


def make_plan(kind: PlanKind, mirror: Mirror, options: PlanOptions | None = None) -> Plan:
    """The plan of one calibration run.

    Raises:
        UnknownNameError: a surface that is not in Table 1; the message names similar ones.
        ValueError: a surface was requested that this mirror cannot make or the plan does not measure, an option is out
            of range, or a plan for hysteresis would not begin with a degauss.
        TooFewMapsError: too few maps to identify the hysteresis of all actuators.
    """
    options = options or PlanOptions()
    names = surfaces.check_names(options.surfaces)
    if options.surfaces and kind not in (PlanKind.FULL, PlanKind.SURFACES):
        raise ValueError(
            f"surfaces = {', '.join(options.surfaces)}: the plan {kind.name.lower()} measures none of them"
        )
    if kind is PlanKind.HYSTERESIS:
        return _hysteresis_plan(mirror, options)
    remarks: list[str] = []
    states: list[Step] = []
    if kind is not PlanKind.SURFACES:
        states += _pokes(mirror, options.poke_amplitude, remarks)
    if kind in (PlanKind.FULL, PlanKind.SURFACES):
        states += _surfaces(names, mirror, bool(options.surfaces), remarks)
    steps = _with_references(states, mirror, options.reference_every)
    if options.degauss:
        steps.insert(0, Step("degauss", StepKind.DEGAUSS))
    return Plan(kind, tuple(steps), tuple(remarks))


def _hysteresis_plan(mirror: Mirror, options: PlanOptions) -> Plan:
    """A degauss, repeated maps at rest, and the excitation with its degausses, each followed by a map at rest."""
    if not options.degauss:
        raise ValueError("skip_degauss = true: hysteresis can only be identified from a degauss on")
    first, *more = _parts(options, mirror.actuators)
    parts = [excitation(mirror, first), *(next_part(mirror, count, seed) for seed, count in enumerate(more, 1))]
    steps = [Step("degauss", StepKind.DEGAUSS), Step("reference 1", StepKind.REFERENCE, mirror.rest)]
    steps += [Step(f"rest {k + 1}", StepKind.EXCITATION, mirror.rest) for k in range(REPEATS)]
    ends, count = set[int](), 0
    for part in parts:
        if count:
            ends.add(len(steps))
        degaussed = part.degaussed
        commands = zip(part.signals, part.dwell, part.settle_share, part.in_use, part.check, strict=True)
        for row, (signals, dwell, share, in_use, check) in enumerate(commands):
            if row in degaussed:
                steps.append(Step(f"degauss {count}", StepKind.DEGAUSS))
                steps.append(Step(f"degaussed {count}", StepKind.DEGAUSSED, mirror.rest))
            count += 1
            kind = StepKind.CHECK if check else StepKind.IN_USE if in_use else StepKind.EXCITATION
            steps.append(Step(f"{kind.value} {count}", kind, signals, dwell=float(dwell), settle_share=float(share)))
            if count % HYSTERESIS_REFERENCE_EVERY == 0:
                number = 1 + count // HYSTERESIS_REFERENCE_EVERY
                steps.append(Step(f"reference {number}", StepKind.REFERENCE, mirror.rest))
    return Plan(PlanKind.HYSTERESIS, tuple(steps), ends=frozenset(ends))


def _parts(options: PlanOptions, actuators: int) -> list[int]:
    """Number of commands in each part of a hysteresis plan: one part, or several if the run may end early."""
    most = options.hysteresis_maps
    if not options.until:
        return [most]
    ends = [PART_STEP * math.ceil(fewest_maps(actuators) / PART_STEP)]
    while ends[-1] < most:
        ends.append(ends[-1] + PART_STEP * max(1, round(NEXT_PART * ends[-1] / PART_STEP)))
    # A remainder that is too short for a part of its own is added to the last part.
    ends = [end for end in ends if end <= most - PART_STEP]
    return np.diff([0, *ends, most]).tolist()


def shape_in_use(step: Step, model: surfaces.LinearModel, mirror: Mirror) -> Step:
    """`step` with the signals that make its shape from a flat surface, as every request does.

    The law is thus fitted and tested where it will be used: about the signals that flatten the mirror. If these are at
    an end of the range, as for a membrane that can only be pulled, levels are spread over the whole range instead.
    """
    assert step.signals is not None
    limits = mirror.limits
    inside = replace(limits, neighbour_difference=IN_USE_ROOM * limits.neighbour_difference)
    flat = surfaces.solve_shape(np.zeros_like(model.sag_offset), model, mirror, inside)[0]
    room = 0.5 * (limits.high - limits.low)
    if abs((flat - mirror.rest).mean()) > ONE_SIDED * room:
        away = step.signals - mirror.rest
        pattern = away - away.mean()
        size = max(float(np.abs(pattern).max()), 1e-12)
        # The level of the step is a share of the range that its pattern leaves. Here it becomes the same share of the
        # whole range, and the pattern is reduced to the range that remains.
        level = IN_USE_ROOM * room * float(np.clip(away.mean() / max(room - size, 1e-12), -1.0, 1.0))
        share = (IN_USE_ROOM * room - abs(level)) / size
        return replace(step, signals=mirror.rest + level + min(share, 1.0) * pattern)
    target = model.influence_sag @ (step.signals - mirror.rest)
    return replace(step, signals=limits.scaled(surfaces.solve_shape(target, model, mirror, inside)[0])[0])


def _pokes(mirror: Mirror, amplitude: float, remarks: list[str]) -> list[Step]:
    """Push, then pull, of each actuator about mid range, one directly after the other."""
    half_range = mirror.limits.half_range
    steps = []
    smallest = 1.0
    for k in range(mirror.actuators):
        for sign, mark in ((1.0, "+"), (-1.0, "-")):
            signals = mirror.rest
            signals[k] += sign * amplitude * half_range
            # Scaling about the mean would move every actuator; a smaller poke keeps the others at rest.
            _, factor = mirror.limits.scaled(signals)
            if factor < 1.0 - SLACK:  # and slightly less, to be inside after rounding
                signals[k] = mirror.rest[k] + factor * (1.0 - 1e-12) * (signals[k] - mirror.rest[k])
            smallest = min(smallest, factor)
            steps.append(Step(f"poke{mark}{k + 1:02d}", StepKind.POKE, signals))
    if smallest < 1.0 - SLACK:
        remarks.append(f"pokes reduced to {smallest:.0%} of +-{amplitude:g} to keep the mirror's limits")
    return steps


def _surfaces(names: Sequence[str], mirror: Mirror, required: bool, remarks: list[str]) -> list[Step]:
    steps = []
    for name in names:
        if reason := surfaces.missing_on(name, mirror):
            if required:
                raise ValueError(f"surface {reason}")
            remarks.append(f"left out: {reason}")
        elif name in surfaces.MODEL_NAMES:
            steps.append(Step(name, StepKind.SURFACE))
        else:
            surface = surfaces.signal_surface(name, mirror)
            steps.append(Step(name, StepKind.SURFACE, surface.signals))
            if surface.remark:
                remarks.append(surface.remark)
    if mirror.actuators > surfaces.TABLE_CHANNELS and not required:
        remarks.append(f"Table 1 has a surface of their own for channels 1 to {surfaces.TABLE_CHANNELS} only")
    return steps


def _with_references(states: Sequence[Step], mirror: Mirror, every: int) -> list[Step]:
    """`states` with a reference frame before, after each `every` steps, and after the last."""
    steps: list[Step] = []
    begins = [*range(0, len(states), every), len(states)]
    for number, begin in enumerate(begins, start=1):
        steps.append(Step(f"reference {number}", StepKind.REFERENCE, mirror.rest))
        steps += states[begin : begin + every]
    return steps
