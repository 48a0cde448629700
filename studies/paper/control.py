"""The control experiments of section 3.2: spheres and conics, started from the states p55 and p56.

The paper starts from the measured surface c_ini and signals s_ini of p55 or p56 and solves Δc = GΔs for the way to the
target. It leaves open when c_ini was measured. Both readings are run, and a closed loop for comparison:

- "stored": c_ini comes from the sample surfaces; no map is taken during control. This is open loop.
- "measured": the mirror goes to p55 or p56, c_ini is measured there, and the mirror moves on from it: one map.
- "closed loop": the stored start, then corrected by maps, three in all; creep is fed forward, and the last correction
  is made but not measured.

An influence function of signals knows neither hysteresis nor creep. In two more readings it is combined with a model
of both, see `hysteresis_control`:

- "stored with hysteresis": open loop as "stored"; no map is taken.
- "closed loop with hysteresis": as "closed loop".

Each method gets the same mirror in the same state, with the same future noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibrator import fit_effective
from dm_calibration.influence.fit import FitOptions
from dm_common import Floats
from dm_common.measurement import Measurement
from dm_common.optics.piston_tilt import remove_plane
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.converge.closed_loop import Creep, LoopOptions, converge
from dm_controller.planning.mirror_model import InfluenceModel, response, target_shape
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Shape, Solver, measured_shape, rms_sag
from studies.comparison.simulated_bench import SimulatedBench, influence_model
from studies.paper.hysteresis_control import HysteresisControl
from studies.paper.regressions import fit_of
from studies.paper.reported import CLAIM_PARTS, CURVATURE_RANGE, WAVELENGTH
from studies.paper.samples import Samples
from studies.solvers.registry import MirrorFacts, make_solver

#: Readings by a linear model alone, and those that follow hysteresis and creep of the actuators.
LINEAR_READINGS = ("stored", "measured", "closed loop")
OPEN_HYSTERESIS, LOOP_HYSTERESIS = "stored with hysteresis", "closed loop with hysteresis"
READINGS = (*LINEAR_READINGS, OPEN_HYSTERESIS, LOOP_HYSTERESIS)
#: Number of maps of a closed loop; pixels across a map that is kept for drawing.
LOOP_MAPS, DRAWN_PIXELS = 3, 160


class Method(NamedTuple):
    """A row of the page.

    Attributes:
        solver: name in `solvers.registry`.
        weights: of regions: "" (none), "median" or "chosen", see `Samples`.
        model: that fitted the influence function.
    """

    solver: str
    weights: str = ""
    model: str = "AZreg"


#: Methods by the name on the page.
METHODS = {
    "AZreg": Method("AZreg"),
    "AZWreg": Method("AZWreg", "median"),
    "AZWreg, ε by cross-validation": Method("AZWreg", "chosen"),
    "AZreg, G by weighted sag fit": Method("AZreg", model="AZWreg"),
    "bounded programme": Method("bounded"),
}


@dataclass(frozen=True, eq=False)
class Shot:
    """One controlled surface.

    Attributes:
        target: what was wanted.
        start: name of the initial state.
        sag: (h, w) m, the last map, piston and tilt removed, thinned out to DRAWN_PIXELS for drawing.
        residual: (h, w) m, the map less the target, likewise.
        zernike: (21,) m, coefficient errors on that map.
        true_zernike: (21,) m, those of the noise-free surface, which only a simulation knows.
        rms: m, of the residual over all pixels.
        overflow: how far the requested signals lay outside the limits, normalised.
        maps: taken during control, without the one that judges it.
    """

    target: FocusTarget
    start: str
    sag: NDArray[np.float32]
    residual: NDArray[np.float32]
    zernike: Floats
    true_zernike: Floats
    rms: float
    overflow: float
    maps: int

    @property
    def max_zernike(self) -> float:
        """Largest coefficient error beyond tilt on the map, m."""
        return float(np.abs(self.zernike[PISTON_TILT:]).max())

    @property
    def true_max_zernike(self) -> float:
        """Largest coefficient error beyond tilt of the noise-free surface, m."""
        return float(np.abs(self.true_zernike[PISTON_TILT:]).max())


@dataclass(frozen=True, eq=False)
class Series:
    """One method in one reading over all targets."""

    method: str
    reading: str
    shots: tuple[Shot, ...]

    @property
    def max_zernike(self) -> Floats:
        """(T,) m, largest coefficient error of each target on its map."""
        return np.array([shot.max_zernike for shot in self.shots])

    @property
    def true_max_zernike(self) -> Floats:
        """(T,) m, largest coefficient error of each target's noise-free surface."""
        return np.array([shot.true_max_zernike for shot in self.shots])

    @property
    def order_errors(self) -> Floats:
        """(T, 4) m, largest coefficient error of the radial orders 2 to 5 of each target's noise-free surface."""
        return order_errors(np.stack([shot.true_zernike for shot in self.shots]))

    def share_within(self, parts: float) -> float:
        """Share of the targets with all true coefficients beyond tilt within wavelength / parts."""
        return share_within(self.true_max_zernike, parts)


def share_within(errors: Floats, parts: float) -> float:
    """Share of the errors (T,), m, within wavelength / parts."""
    return float((errors <= WAVELENGTH / parts).mean())


def spheres(count: int) -> tuple[FocusTarget, ...]:
    """`count` spheres evenly over the paper's range of curvature."""
    return tuple(FocusTarget(round(float(c), 6)) for c in np.linspace(*CURVATURE_RANGE, count))


def aspheres() -> tuple[FocusTarget, ...]:
    """Conic bases of Eq. (2), alone and with an additive deviation as in Eq. (3): Z_4^0 of 100 nm."""
    deviation = np.zeros(21)
    deviation[10] = 100e-9
    bases = [(c, k) for c in CURVATURE_RANGE for k in (-1.0, -10.0)]
    return tuple(FocusTarget(c, k) for c, k in bases) + tuple(
        FocusTarget(c, -1.0, tuple(deviation)) for c in CURVATURE_RANGE
    )


def initial_state(target: FocusTarget) -> str:
    """The initial state nearer to a target: p55 (R = +60 m, concave) or p56 (R = -60 m, convex)."""
    return "p55" if target.curvature >= 0.0 else "p56"


def make_method(name: str, samples: Samples, model: InfluenceModel | None = None) -> Solver:
    """The solver of a row of METHODS on `model`; None = the influence function of `samples` on applied signals."""
    method = METHODS[name]
    chosen = {"": None, "median": samples.median_weights, "chosen": samples.weighting.weights}[method.weights]
    if model is None:
        fit = fit_of(samples.calibration, samples.bench, method.model)
        model = influence_model(fit, samples.bench.mirror.working_radius)
    return make_solver(method.solver, model, samples.bench.limits, MirrorFacts(region_weights=chosen))


def _effective_method(name: str, samples: Samples) -> Solver:
    """The solver of a row of METHODS on the influence function of `samples` on effective signals."""
    options, mirror = FitOptions(method=METHODS[name].model), samples.bench.mirror
    fit = fit_effective(samples.calibration.maps, samples.hysteresis, options, mirror)
    return make_method(name, samples, influence_model(fit, mirror.working_radius))


def run_series(
    samples: Samples,
    method: str,
    reading: str,
    targets: Sequence[FocusTarget],
    on_shot: Callable[[], None] = lambda: None,
) -> Series:
    """Control `targets` one after another on a copy of the samples' simulation.

    Raises:
        ValueError: an unknown reading.
    """
    if reading not in READINGS:
        raise ValueError(f"reading = {reading!r}: must be one of {', '.join(READINGS)}")
    linear, bench = reading in LINEAR_READINGS, samples.bench.fork()
    solver = make_method(method, samples) if linear else _effective_method(method, samples)
    following = None if linear else HysteresisControl(samples, bench, solver)
    shots = []
    for target in targets:
        start = initial_state(target)
        if following is None:
            overflow, taken = _control(samples, bench, solver, reading, target)
        else:
            row, wanted = samples.row(start), target_shape(target, solver.model)
            _go(bench, samples.calibration.maps.applied[row])
            effective, overflow = following.start(row, wanted)
            taken = LOOP_MAPS if reading == LOOP_HYSTERESIS else 0
            following.converge(effective, wanted, taken)
        shots.append(_judge(bench, target, start, overflow, taken))
        on_shot()
    return Series(method, reading, tuple(shots))


def _control(
    samples: Samples, bench: SimulatedBench, solver: Solver, reading: str, target: FocusTarget
) -> tuple[float, int]:
    """Bring the mirror to `target` by the influence function alone; returns overflow and the number of maps taken."""
    row, maps = samples.row(initial_state(target)), samples.calibration.maps
    signals = maps.applied[row]
    wanted = target_shape(target, solver.model)
    _go(bench, signals)
    if reading == "measured":
        initial, taken = _shape(bench.measure("start"), solver), 1
    else:
        initial, taken = measured_shape(maps.coefficients[row], maps.sag[row], solver.model), 0
    command = solver.correct(signals, initial - wanted)
    if reading == "closed loop":
        options = LoopOptions(tolerance=WAVELENGTH / CLAIM_PARTS[1], max_maps=LOOP_MAPS, correct_last=True)
        creep = Creep.of_rate(samples.hysteresis.law.creep_rate, signals, lambda: bench.time)
        taken = converge(solver, target, bench, options, start=command.signals, creep=creep).maps
    else:
        _go(bench, command.signals)
    return command.overflow, taken


def _go(bench: SimulatedBench, signals: Floats) -> None:
    bench.apply(signals)
    bench.settle()


def _shape(measured: Measurement, solver: Solver) -> Shape:
    return measured_shape(measured.coefficients, measured.sag, solver.model)


def _judge(bench: SimulatedBench, target: FocusTarget, start: str, overflow: float, taken: int) -> Shot:
    """Take a map of the present surface and compare it with the target."""
    bench.time += bench.config.exposure
    sag = bench.take_map()
    aperture, radius = bench.aperture, bench.mirror.working_radius
    x: Floats = (np.arange(sag.shape[1], dtype=np.float64)[None, :] - aperture.centre_x_px) / aperture.radius_px
    y: Floats = (aperture.centre_y_px - np.arange(sag.shape[0], dtype=np.float64)[:, None]) / aperture.radius_px
    residual = remove_plane(sag - target.sag(x, y, radius))
    wanted = target.coefficients(radius)
    zernike = bench.measurement_of(sag).coefficients - wanted
    true = bench.measurement_of(bench.true_map()).coefficients - wanted
    rms = float(np.sqrt(np.nanmean(np.square(residual))))
    drawn = _thinned(remove_plane(sag))
    return Shot(target, start, drawn, _thinned(residual), zernike, true, rms, overflow, taken)


def _thinned(sag: Floats) -> NDArray[np.float32]:
    """Every n-th pixel, so that about DRAWN_PIXELS are left across."""
    step = max(1, round(len(sag) / DRAWN_PIXELS))
    return sag[::step, ::step].astype(np.float32)


def branch_spread(samples: Samples) -> float:
    """Largest coefficient difference of one command, p55, reached from the two ends of the range of curvature, m.

    On the bench without hysteresis, the two p55 differ by noise only.
    """
    solver, bench = make_method("bounded programme", samples), samples.bench.fork()
    signals = samples.calibration.maps.applied[samples.row("p55")]
    reached = []
    for curvature in CURVATURE_RANGE:
        _go(bench, solver.solve(target_shape(FocusTarget(curvature), solver.model)).signals)
        _go(bench, signals)
        reached.append(bench.measure("p55").coefficients)
    return float(np.abs(reached[1] - reached[0])[PISTON_TILT:].max())


def fitting_limit(samples: Samples, target: FocusTarget) -> tuple[float, float]:
    """Best that the bounded programme predicts for a linear mirror: rms sag and largest coefficient error, m."""
    solver = make_method("bounded programme", samples)
    wanted = target_shape(target, solver.model)
    signals = solver.solve(wanted).signals
    model = solver.model
    left = response(model, signals) + solver.offset - wanted
    return rms_sag(left, model), left.max_zernike


def order_errors(zernike: Floats) -> Floats:
    """(..., 4) largest absolute coefficient of each radial order 2 to 5 in (..., 21)."""
    return np.stack([np.abs(zernike[..., a:b]).max(axis=-1) for a, b in pairwise((3, 6, 10, 15, 21))], axis=-1)
