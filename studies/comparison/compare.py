"""All methods side by side on the same simulations: their errors on a sweep of spheres, and their cost in time.

Each seed is a simulation of its own, calibrated once by the full plan. Every method then starts from the same state
of that simulation, future noise included, after a degauss, and goes through the same spheres in the same random
order. Open-loop rows use the solver's command as it is; closed-loop rows let the same solver correct it with the
interferometer, and feed creep forward at the rate identified from the maps of the calibration.

Errors are those of the true surface, which only a simulation knows: otherwise a loop that stops on its own measurement
would be judged by the noise it stopped on. Curvature 0 has no peak to valley and is left out of the relative figures.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_calibration.hysteresis.hysteresis_fit import fit_hysteresis
from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.maps import StepKind
from dm_calibration.influence.region_weighting import choose_weighting
from dm_calibration.influence.regression import make_design, regress
from dm_calibration.procedure.procedure import Progress
from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.limits import Limits
from dm_controller.converge.closed_loop import Creep, LoopOptions, converge
from dm_controller.planning.mirror_model import InfluenceModel, target_shape
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Solver
from dm_controller.solvers.least_squares import PseudoInverse
from dm_tools.running_suite import CURVATURES
from dm_tools.verify import SurfaceError, surface_error
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model, plan_steps
from studies.solvers.registry import SOLVERS, MirrorFacts, check_method, make_solver
from studies.solvers.steepest_descent import SteepestDescent

#: Suffix of the name of a method in the closed loop.
CLOSED = "_closed_loop"
#: Methods older than [1]: their influence matrix is from single pokes, without the surfaces of Table 1.
CLASSICAL = (PseudoInverse.name, SteepestDescent.name)


@dataclass(frozen=True)
class CompareOptions:
    """What to compare on.

    Attributes:
        simulation: the simulation; its seed is replaced by each of `seeds`.
        seeds: of the simulations; the order of the sweep follows from them too.
        methods: names of solvers; empty = all.
        curvatures: of the spheres, 1/m.
        loop: of the closed-loop rows; by default wavelength / 1000, and three iterations of measuring and correcting.
    """

    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    seeds: Sequence[int] = (1,)
    methods: Sequence[str] = ()
    curvatures: Sequence[float] = CURVATURES
    loop: LoopOptions = field(default_factory=lambda: LoopOptions(632.8e-12, 3, correct_last=True))

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ValueError("seeds: at least one is needed")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds = {list(self.seeds)}: name each seed once; twice says nothing new")
        if min(self.seeds) < 0:
            raise ValueError(f"seeds = {list(self.seeds)}: must not be negative")
        if not any(self.curvatures):
            raise ValueError("curvatures: at least one other than 0 is needed")
        for name in self.methods:
            check_method(name)


@dataclass(frozen=True, eq=False)
class Trial:
    """One set-point by one method.

    Attributes:
        seed, method, closed: which.
        curvature: 1/m.
        max_zernike: largest coefficient error beyond tilt of the true surface, m.
        rms: of the true surface's error, piston and tilt removed, m.
        maps: taken by the loop.
        seconds: bench time of moves, settling and maps, and computing time.
    """

    seed: int
    method: str
    closed: bool
    curvature: float
    max_zernike: float
    rms: float
    maps: int
    seconds: float


@dataclass(frozen=True)
class MethodFigures:
    """One row: medians and percentiles over all set-points and seeds."""

    p50: float  # m, largest coefficient error
    p90: float
    rms_share: float  # median of rms sag error over PV of the sphere
    maps: float  # median
    seconds: float  # median


@dataclass(frozen=True, eq=False)
class Comparison:
    """All rows, and the limit for every method.

    Attributes:
        trials: every set-point.
        fitting_limit: rms sag error of the ideal command inside the limits for the hardest sphere of the sweep, m;
            median over the seeds.
        fitting_limit_share: the same over PV, median over all spheres.
        radius: of the working aperture, m.
        creep_rates: per decade, for each seed, identified from its calibration; the loops feed creep forward with it.
    """

    trials: tuple[Trial, ...]
    fitting_limit: float
    fitting_limit_share: float
    radius: float
    creep_rates: tuple[float, ...]

    def rows(self) -> dict[str, MethodFigures]:
        """Figures by method, closed-loop rows with CLOSED added to the name."""
        groups: dict[str, list[Trial]] = {}
        for trial in self.trials:
            groups.setdefault(trial.method + (CLOSED if trial.closed else ""), []).append(trial)
        return {name: self._figures(group) for name, group in groups.items()}

    def _figures(self, trials: list[Trial]) -> MethodFigures:
        worst = [trial.max_zernike for trial in trials]
        shares = [t.rms / peak_to_valley(t.curvature, self.radius) for t in trials if t.curvature]
        return MethodFigures(
            p50=float(np.quantile(worst, 0.5)),
            p90=float(np.quantile(worst, 0.9)),
            rms_share=float(np.median(shares)),
            maps=float(np.median([trial.maps for trial in trials])),
            seconds=float(np.median([trial.seconds for trial in trials])),
        )


def peak_to_valley(curvature: float, radius: float) -> float:
    """PV of a weakly curved sphere over an aperture, m."""
    return abs(curvature) * radius**2 / 2.0


@dataclass(frozen=True)
class _MapInfo:
    """The fields of a map that `surface_error` uses."""

    centre_x: float
    centre_y: float
    aperture_radius_px: float
    aperture_radius: float


def true_error(bench: SimulatedBench, target: FocusTarget) -> SurfaceError:
    """The true surface of the simulation against `target`."""
    aperture = bench.aperture
    info = _MapInfo(aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px, aperture.radius_px * bench.pitch)
    return surface_error(bench.true_map(), info, target)


def fitting_limits(bench: SimulatedBench, curvatures: Sequence[float]) -> Floats:
    """(C,) rms sag error of the best possible displacements of this mirror inside its stroke, m.

    Computed from the true influence functions and figure, without hysteresis, creep and noise.
    """
    influence, figure = bench.true_influence()
    rows, columns = np.nonzero(np.isfinite(bench.true_map()))
    aperture = bench.aperture
    x: Floats = (columns.astype(float) - aperture.centre_x_px) / aperture.radius_px
    y: Floats = (aperture.centre_y_px - rows.astype(float)) / aperture.radius_px
    plane = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]

    def tilt_free(sag: Floats) -> Floats:
        result: Floats = sag - plane @ (plane.T @ sag)
        return result / np.sqrt(len(x))

    matrix = tilt_free(influence * bench.true_stroke)
    box = Limits(bench.limits.low, bench.limits.high, bench.limits.pairs, bench.limits.neighbour_difference)
    programme = BoundedProgramme(matrix, box, ridge=1e-26)
    limits = []
    for curvature in curvatures:
        wanted = tilt_free(FocusTarget(curvature).sag(x, y, bench.mirror.working_radius) - figure)
        limits.append(np.linalg.norm(matrix @ programme.solve(wanted) - wanted))
    return np.array(limits)


def poke_model(calibration: Calibration) -> InfluenceModel:
    """The influence function from the pokes and reference frames alone."""
    maps = calibration.maps.select(np.array([kind != StepKind.SURFACE for kind in calibration.maps.kind], dtype=bool))
    return influence_model(fit_influence(maps, FitOptions()), calibration.aperture_radius)


def region_weights_of(calibration: Calibration) -> Floats:
    """(10,) weights of Eq. (8) from the surfaces of a calibration, epsilon by cross-validation."""
    maps = calibration.maps.select(calibration.fit.used)
    design = make_design(maps)
    _, responses = regress(design, maps)
    return choose_weighting(design, maps, responses[:, maps.terms :]).weights


def make_solvers(calibration: Calibration, limits: Limits, methods: Sequence[str]) -> dict[str, Solver]:
    """The solvers, each with the influence function that it would have in use."""
    full = influence_model(calibration.fit, calibration.aperture_radius)
    pokes = poke_model(calibration) if any(name in CLASSICAL for name in methods) else full
    facts = MirrorFacts(calibration.actuator_x, calibration.actuator_y, region_weights_of(calibration))
    return {name: make_solver(name, pokes if name in CLASSICAL else full, limits, facts) for name in methods}


def _sweep(
    bench: SimulatedBench,
    solver: Solver,
    order: Sequence[float],
    loop: LoopOptions | None,
    creep_rate: float,
) -> list[Trial]:
    bench.degauss()
    bench.settle()
    before = bench.mirror.rest
    trials = []
    for curvature in order:
        target = FocusTarget(curvature)
        began, computing = bench.time, time.perf_counter()
        maps = 0
        if loop:
            creep = Creep.of_rate(creep_rate, before, lambda: bench.time)
            result = converge(solver, target, bench, loop, creep=creep)
            before, maps = result.signals, result.maps
        else:
            before = solver.solve(target_shape(target, solver.model)).signals
            bench.apply(before)
            bench.settle()
        seconds = bench.time - began + time.perf_counter() - computing
        error = true_error(bench, target)
        trials.append(
            Trial(bench.config.seed, solver.name, bool(loop), curvature, error.max_zernike, error.rms, maps, seconds)
        )
    return trials


def total_steps(options: CompareOptions) -> int:
    """Steps that `compare` reports."""
    return len(options.seeds) * (plan_steps() + 1 + 2 * len(options.methods or SOLVERS))


def compare(options: CompareOptions, progress: Callable[[str], None] = lambda step: None) -> Comparison:
    """Run the comparison.

    Args:
        progress: called with a description before each of `total_steps` steps.

    Raises:
        UnknownNameError: an unknown method, listing all.
        TooFewMapsError, Refusal: a simulation could not be calibrated.
    """
    methods = tuple(dict.fromkeys(options.methods)) or tuple(SOLVERS)
    trials: list[Trial] = []
    limits: list[float] = []
    shares: list[float] = []
    creep_rates: list[float] = []
    radius = 0.0
    for seed in options.seeds:
        bench = SimulatedBench(replace(options.simulation, seed=seed))
        radius = bench.mirror.working_radius

        def calibrating(now: Progress, seed: int = seed) -> None:
            if now.done < now.steps:
                progress(f"seed {seed}: calibration {now.label}")

        calibration = bench.calibrate(progress=calibrating)
        progress(f"seed {seed}: creep")
        creep_rates.append(fit_hysteresis(calibration.maps, COMMON).law.creep_rate)
        limit = fitting_limits(bench, options.curvatures)
        limits.append(float(limit.max()))
        shares += [r / peak_to_valley(c, radius) for r, c in zip(limit, options.curvatures, strict=True) if c]
        order = [float(c) for c in np.random.default_rng(seed).permutation(options.curvatures)]
        solvers = make_solvers(calibration, bench.limits, methods)
        for loop in (None, options.loop):
            for name, solver in solvers.items():
                progress(f"seed {seed}: {name}{', closed loop' if loop else ''}")
                trials += _sweep(bench.fork(), solver, order, loop, creep_rates[-1])
    return Comparison(tuple(trials), float(np.median(limits)), float(np.median(shares)), radius, tuple(creep_rates))
