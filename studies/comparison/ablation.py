"""What each part of the hysteresis model contributes: open loop, random order, simulations of several laws.

Each seed is a simulation of its own, calibrated once by the plan HYSTERESIS; all models are fitted to the same maps.
Requests are spheres of random curvature, each held for its own dwell time; the true surface is judged at the end of
the dwell. The models know of the simulation only what the driver reports.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.procedure.procedure import Progress
from dm_common import Floats
from dm_controller.planning.target import FocusTarget
from studies.comparison.ablation_figures import Ablation, Identified, Requests, Series
from studies.comparison.ablation_models import MODELS, Variant, make_variants
from studies.comparison.driven_mirror import DrivenMirror
from studies.comparison.random_requests import CURVATURE_MAX, DWELLS
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, plan_steps
from studies.comparison.true_surface import TrueSurface

#: What precedes the requests. Tracked: everything that the calibration did, and no degauss. Power cycle: power off for
#: a time in which creep continues unobserved, then a degauss.
#: Conditioned: a degauss before each request, as recipes require.
TRACKED, DEGAUSSED, POWER_CYCLE, CONDITIONED = "tracked", "degaussed", "power cycle", "conditioned"
HISTORIES = (TRACKED, DEGAUSSED, POWER_CYCLE)
#: Hysteresis laws of the simulations; `mixed` is a law that no candidate of the identification contains.
PLANTS = ("prandtl_ishlinskii", "preisach", "bouc_wen", "mixed")
#: The longest hold, s; the time from which its drift counts, s; and its curvature, 1/m.
HOLD_S, HOLD_FROM_S, HOLD_CURVATURE = 3600.0, 1.0, 0.03


@dataclass(frozen=True)
class AblationOptions:
    """What to run.

    Attributes:
        simulation: its law and seed are replaced by each of `plants` and `seeds`.
        requests: per seed and history.
        maps: of the calibration.
        power_off: length of a power cycle, s.
    """

    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    plants: Sequence[str] = PLANTS
    seeds: Sequence[int] = (1, 2, 3, 4, 5)
    histories: Sequence[str] = HISTORIES
    requests: int = 40
    maps: int = 300
    power_off: float = 600.0

    def __post_init__(self) -> None:
        if not self.seeds or not self.plants or not self.histories:
            raise ValueError("seeds, plants and histories: at least one each is needed")
        if self.requests < len(DWELLS):
            raise ValueError(f"requests = {self.requests}: must be at least {len(DWELLS)}, one of each dwell time")
        for name in self.histories:
            if name not in HISTORIES:
                raise ValueError(f"history = {name!r}: must be one of {', '.join(HISTORIES)}")


def _prepare(bench: SimulatedBench, history: str, power_off: float) -> SimulatedBench:
    bench = bench.fork()
    if history == POWER_CYCLE:
        bench.power_cycle(power_off)
    if history != TRACKED:
        bench.degauss()
        bench.settle()
    return bench


def _sequence(
    bench: SimulatedBench, variant: Variant, surface: TrueSurface, curvatures: Floats, dwells: Floats, limits: Floats
) -> tuple[Requests, float]:
    """The outcome of the requests in order, and then the drift of a shape held for an hour, m."""
    mirror = DrivenMirror(bench, variant.loop, variant.holds, variant.book)
    targets = [FocusTarget(float(c)) for c in curvatures]
    upper, displacements = [], []
    for target, dwell in zip(targets, dwells, strict=True):
        move = mirror.go(mirror.plan(target))
        mirror.hold(move, float(dwell))
        upper.append(move.plan.max_zernike_upper)
        displacements.append(bench.true_displacement)
    errors, rms = surface.errors(np.array(displacements), targets)
    requests = Requests(dwells, curvatures, np.abs(errors).max(axis=1), np.array(upper), rms, limits)
    return requests, _drift(mirror, surface)


def _drift(mirror: DrivenMirror, surface: TrueSurface) -> float:
    """Largest change of a coefficient while a shape is held for HOLD_S, from HOLD_FROM_S after the move on, m."""
    target = FocusTarget(HOLD_CURVATURE)
    move = mirror.go(mirror.plan(target))
    displacements = []
    began = mirror.bench.time
    mirror.hold(move, HOLD_FROM_S)
    displacements.append(mirror.bench.true_displacement)
    mirror.hold(move, HOLD_S - (mirror.bench.time - began))
    displacements.append(mirror.bench.true_displacement)
    errors, _ = surface.errors(np.array(displacements), [target] * len(displacements))
    return float(np.abs(errors[-1] - errors[0]).max())


def total_steps(options: AblationOptions) -> int:
    """Steps that `ablate` reports."""
    runs = len(options.plants) * len(options.seeds)
    plan = plan_steps(PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=options.maps))
    return runs * (plan + 1 + (len(MODELS) - 1) * len(options.histories) + 1)


def ablate(options: AblationOptions, progress: Callable[[str], None] = lambda step: None) -> Ablation:
    """Run the ablation.

    Args:
        progress: called with a description before each of `total_steps` steps.

    Raises:
        TooFewMapsError, Refusal: a simulation could not be calibrated.
    """
    parts: dict[tuple[str, str, str], list[tuple[Requests, float]]] = {}
    identified = []
    radius = 0.0
    for plant in options.plants:
        for seed in options.seeds:
            where = f"{plant}, seed {seed}"
            bench = SimulatedBench(replace(options.simulation, law=plant, seed=seed))
            radius = bench.mirror.working_radius

            def calibrating(now: Progress, where: str = where) -> None:
                if now.done < now.steps:
                    progress(f"{where}: calibration {now.label}")

            calibration = bench.calibrate(
                PlanKind.HYSTERESIS, PlanOptions(hysteresis_maps=options.maps), progress=calibrating
            )
            progress(f"{where}: identification")
            hysteresis = calibration.hysteresis
            assert hysteresis is not None
            identified.append(Identified(plant, seed, hysteresis.name, hysteresis.held_out_max_zernike))
            surface = TrueSurface(bench)
            rng = np.random.default_rng([seed, 4])
            curvatures = rng.uniform(-CURVATURE_MAX, CURVATURE_MAX, options.requests)
            dwells = rng.permutation(np.resize(DWELLS, options.requests))
            limits = surface.limits([FocusTarget(float(c)) for c in curvatures])
            variants = make_variants(bench, calibration)
            prepared = {h: _prepare(bench, h, options.power_off) for h in (*options.histories, CONDITIONED)}
            for variant in variants:
                for history in (CONDITIONED,) if variant.book.recipes else options.histories:
                    progress(f"{where}: {variant.name}, {history}")
                    outcome = _sequence(prepared[history].fork(), variant, surface, curvatures, dwells, limits)
                    parts.setdefault((plant, variant.name, history), []).append(outcome)
    series = tuple(
        Series(*key, Requests.pooled(r for r, _ in outcomes), np.array([drift for _, drift in outcomes]))
        for key, outcomes in parts.items()
    )
    return Ablation(series, tuple(identified), radius)
