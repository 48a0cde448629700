"""Accuracy against number of maps on random mirrors: the plan HYSTERESIS, and patterns that ignore hysteresis."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import hadamard

from dm_calibration.calibration_messages import calibration_message
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.procedure.plan import Plan, PlanKind, PlanOptions, Step, StepKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_common import Floats
from dm_common.errors import Refusal
from dm_common.mirror import Mirror
from studies.comparison.drawn_mirrors import draw_mirror
from studies.comparison.driven_mirror import DrivenMirror
from studies.comparison.population import held_for_a_day
from studies.comparison.random_requests import Requests, active_of, draw_targets, judge_requests
from studies.comparison.simulated_bench import SimulatedBench
from studies.comparison.true_surface import TrueSurface

#: Plans: random shapes to identify hysteresis, patterns of all actuators, one actuator at a time.
HYSTERESIS, HADAMARD, PUSH_PULL = "hysteresis", "Hadamard", "push-pull"
METHODS = (HYSTERESIS, HADAMARD, PUSH_PULL)
#: Half-swing of a pattern: neighbours that move in opposite directions stay within the shipped limit.
HALF_SWING = 0.499
#: Number of requests to each calibration; time for which each is held, s; largest error of a good one, m: the
#: wavelength of the interferometer / 200.
REQUESTS, DWELL, GOAL = 20, 1.0, 632.8e-9 / 200


@dataclass(frozen=True, eq=False)
class FewMaps:
    """One calibration and how good it was.

    Attributes:
        maps: number requested; plans of hysteresis add some at rest.
        taken, seconds: maps taken and duration, from the initial degauss on, which is included.
        failure: the reason why there are no requests; "" = there are.
    """

    seed: int
    method: str
    maps: int
    taken: int
    seconds: float
    requests: Requests
    failure: str = ""


def patterns(method: str, mirror: Mirror, count: int) -> Floats:
    """(count, N) signals: each actuator pushed, then pulled; or all Hadamard patterns pushed, then all pulled."""
    actuators = mirror.actuators
    if method == PUSH_PULL:
        both = np.eye(actuators).repeat(2, axis=0) * np.resize((1.0, -1.0), (2 * actuators, 1))
    else:
        pushed = hadamard(2 ** int(np.ceil(np.log2(actuators + 1))))[:, 1 : 1 + actuators]
        both = np.vstack((pushed, -pushed))
    rows = both[np.arange(count) % len(both)]
    return np.asarray(mirror.rest + HALF_SWING * mirror.limits.half_range * rows)


def plan_of(method: str, mirror: Mirror, maps: int) -> Plan:
    """The plan with this number of maps.

    Raises:
        TooFewMapsError, ValueError: a plan of hysteresis with too few or too many.
    """
    if method == HYSTERESIS:
        return make_plan(PlanKind.HYSTERESIS, mirror, PlanOptions(hysteresis_maps=maps))
    steps = [Step(f"{method} {k}", StepKind.POKE, row) for k, row in enumerate(patterns(method, mirror, maps))]
    return Plan(PlanKind.POKES, (Step("degauss", StepKind.DEGAUSS), *steps))


def judge_few_maps(seed: int, method: str, maps: int, pixels: int = 236) -> FewMaps:
    """Draw the mirror of `seed`, calibrate it from power-on, and judge requests at 1 s each; none where it fails."""
    drawn = draw_mirror(seed, pixels)
    bench = SimulatedBench(drawn.simulation)
    rng = np.random.default_rng([seed, 15])
    if drawn.held_before:
        held_for_a_day(bench, rng)
    began, failure, judged = bench.time, "", Requests.none(())
    try:
        procedure = Procedure(plan_of(method, bench.mirror, maps), bench.mirror, bench)
        outcome = procedure.run()
        seconds, taken = bench.time - began, bench.maps
        bench.apply(bench.mirror.rest)
        calibration = calibrate(outcome, mirror=bench.mirror, provenance=Provenance(bench.mirror.serial, 1))
        active = active_of(bench, calibration_message(calibration, None, "mirror", 1.0))
        targets = draw_targets(active, REQUESTS, rng)
        judged = judge_requests(
            DrivenMirror(bench, active.planner), active, TrueSurface(bench), targets, np.full(REQUESTS, DWELL)
        )
    except (Refusal, ValueError) as error:
        seconds, taken, failure = bench.time - began, bench.maps, str(error)
    return FewMaps(seed, method, maps, taken, seconds, judged, failure)


def judge_all(seeds: Sequence[int], maps: Sequence[int], pixels: int, workers: int) -> Iterator[FewMaps]:
    """Every method with every number of maps on the mirror of each seed, in any order.

    Args:
        workers: processes.
    """
    jobs = [(seed, method, count, pixels) for count in maps for seed in seeds for method in METHODS]
    with multiprocessing.get_context("spawn").Pool(min(workers, len(jobs)), maxtasksperchild=4) as pool:
        yield from pool.imap_unordered(_judge_one, jobs)


def _judge_one(job: tuple[int, str, int, int]) -> FewMaps:
    return judge_few_maps(*job)
