"""The virtual bench in process: mirror, electronics and interferometer without sockets, files or waiting.

Implements `dm_common.measurement.Bench`, so calibrations and closed loops on it run the code they run on hardware.
A seed determines the same as on the virtual bench behind sockets: gains, initial figure and noise.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.surfaces import LinearModel
from dm_calibration.optics.aperture import Aperture
from dm_calibration.optics.map_fit import MapFitter
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Procedure, ProcedureOptions, Progress
from dm_common import Floats
from dm_common.limits import Limits
from dm_common.measurement import Measurement
from dm_common.mirror import Applied, Mirror
from dm_common.optics.sampling import edge_clustered_points, sample_map
from dm_controller.planning.mirror_model import InfluenceModel
from dm_driver.degauss import degauss_waypoints
from dm_driver.output.volts import VoltScale
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter
from dm_simulation.electronics.drive_unit import EDAC40_FULL_SCALE, DriveConfig, DriveUnit
from dm_simulation.electronics.frames import EDAC40_VALUE, EdacFrame
from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.mirror.piezo import PiezoActuators
from dm_simulation.mirror.plate import Plate, PlateConfig, neighbour_pairs
from studies.comparison.bench_config import SimulationConfig

#: Pixels across the camera for which the numbers of specks are given.
FULL_CAMERA = InterferometerConfig().pixels
#: Shortest time between two reports of the driver during a degauss, s.
REPORT_INTERVAL_S = 0.02


class SimulatedBench:
    """One simulation with a time of its own, which only moves, waits and maps advance.

    Raises:
        ValueError: a configuration that is not valid, naming the parameter.

    Attributes:
        mirror: as the calibration knows it.
        limits: of its signals, as solvers take them.
        piezo: its actuators, which only an experiment may touch.
        time: s since the start.
        maps: maps taken so far.
        latest: the last of them; None = none yet.
        reports: what the driver would have reported after each move, from the first power-on.
    """

    def __init__(self, config: SimulationConfig | None = None) -> None:
        self.config = config = config or SimulationConfig()
        gains, figure, noise = (np.random.default_rng(s) for s in np.random.SeedSequence(config.seed).spawn(3))
        self.plate = Plate(config.plate)
        self._drive = DriveUnit(DriveConfig())
        drive = self._drive.config
        self._scale = VoltScale(
            EDAC40_FULL_SCALE,
            drive.dac_volts_at_zero,
            drive.dac_volts_at_full,
            drive.amplifier_gain,
            drive.volts_min,
            drive.volts_max,
        )
        self._channels = np.asarray(drive.wiring)
        piezo = replace(config.piezo, law=config.law, hysteresis=config.hysteresis, creep=config.creep)
        self.piezo = PiezoActuators(piezo, gains, self._drive.signals(), 0.0)
        share = (config.pixels / FULL_CAMERA) ** 2
        camera = replace(config.instrument, pixels=config.pixels, specks=round(config.instrument.specks * share))
        self._interferometer = Interferometer(camera, self.plate, figure, noise)
        self._noise = noise
        self._points = edge_clustered_points(config.samples)
        pairs = neighbour_pairs(self.plate.x, self.plate.y)
        self._limiter = SafetyLimiter(
            DriverLimits(actuators=len(self.plate.x), pairs=pairs, neighbour_difference=config.neighbour_difference)
        )
        self._fitter: MapFitter | None = None
        self._written: Floats = self._drive.signals()
        self._turns = self._degausses = 0
        self._turned_at: Floats | None = None
        #: Largest slew rate of the signals, 1/s.
        self.slew_rate = self._limiter.limits.slew_rate
        self.time = self._moved = 0.0
        self.maps = 0
        self.latest: Measurement | None = None
        self.reports: list[Applied] = []
        self._report()
        self.limits = Limits(-1.0, 1.0, pairs, config.neighbour_difference)
        self.mirror = Mirror(
            "PDM30-37", f"simulation-{config.seed}", self.plate.x, self.plate.y, camera.field_diameter / 2, self.limits
        )

    def fork(self) -> SimulatedBench:
        """A second bench in exactly this state, future noise included, so that methods can be compared."""
        other = copy.copy(self)
        other._drive, other.piezo = copy.deepcopy(self._drive), copy.deepcopy(self.piezo)
        other._noise = copy.deepcopy(self._noise)
        other._interferometer = copy.copy(self._interferometer)  # what never changes is shared
        other._interferometer.noise = other._noise
        other._fitter = None
        other.reports = list(self.reports)
        return other

    # --- dm_common.measurement.Bench ---

    def degauss(self) -> None:
        """Demagnetise as the driver does, and end at mid range."""
        rest = self.mirror.rest
        points = degauss_waypoints(len(rest), float(rest[0]), self.limits.half_range, self.config.degauss_steps, rest)
        self._follow(list(self._limiter.path(self._written, points)), known=False)
        self._turns, self._degausses = self._turns + 1, self._degausses + 1
        self._turned_at = self._drive.signals()
        self._report()

    def apply(self, signals: Floats) -> Floats:
        """Ramp to `signals` (N,) by the driver's limiter, through the codes of the DAC; returns what was written.

        Raises:
            dm_common.errors.Refusal: signals that the driver would refuse.
        """
        target = self._limiter.check_shape(signals)
        if not np.array_equal(target, self._written):
            self._turns, self._turned_at = self._turns + 1, self._drive.signals()
        self._follow(list(self._limiter.ramp(self._written, target)))
        self._report()
        return self._drive.signals()

    def power_cut(self, signals: Floats, share: float) -> None:
        """Begin the move to `signals` (N,) and cut the power after `share` of its steps."""
        way = list(self._limiter.ramp(self._written, self._limiter.check_shape(signals)))
        self._follow(way[: round(share * len(way))])

    def power_cycle(self, off: float) -> None:
        """Switch the electronics off for `off` s and on again: the actuators rest at 0 V, the driver starts anew."""
        self._drive = DriveUnit(self._drive.config)
        self._written = self._drive.signals()
        self.piezo.apply(self._written, self.time)
        self.time += off
        self._moved = self.time
        self._turns = self._degausses = 0
        self._turned_at = None
        self._report()

    def _report(self, known: bool = True, moving: bool = False) -> None:
        known = known and self._degausses > 0
        self.reports.append(
            Applied(self._moved, self._drive.signals(), self._turns, self._turned_at, self._degausses, known, moving)
        )

    def _follow(self, shapes: list[Floats], known: bool = True) -> None:
        """Write a sequence of shapes, reporting as often as the driver does."""
        reported = -REPORT_INTERVAL_S
        for shape in shapes:
            self._drive.take_edac40(EdacFrame(EDAC40_VALUE, self._channels, self._scale.codes(shape)))
            self.piezo.apply(self._drive.signals(), self.time)
            self._moved = self.time
            self.time += self._limiter.pause_after(self._written, shape)
            self._written = shape
            if self._moved - reported >= REPORT_INTERVAL_S:
                reported = self._moved
                self._report(known, moving=True)

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        """Let this `share` of the settle time and `dwell` s pass."""
        self.time += share * self.config.settle_time + dwell
        return True

    def measure(self, label: str) -> Measurement:
        """Take one map, fit and sample it as the interferometer node does a file."""
        self.time += self.config.exposure
        self.maps += 1
        self.latest = self.measurement_of(self.take_map())
        return self.latest

    # --- the map itself ---

    def take_map(self) -> Floats:
        """One noisy map (pixels, pixels), m, at this moment; row 0 = top, NaN = no data."""
        self.piezo.advance(self.time)
        return self._interferometer.measure(self.piezo.displacement, self.time)

    def true_map(self) -> Floats:
        """The noise-free surface (pixels, pixels), m, at this moment: for judging only."""
        self.piezo.advance(self.time)
        return self._interferometer.true_sag(self.piezo.displacement)

    @property
    def pitch(self) -> float:
        """m per pixel."""
        return self._interferometer.pitch

    @property
    def aperture(self) -> Aperture:
        """The working aperture on the maps."""
        pixels = self.config.pixels
        return Aperture.configured((pixels, pixels), self.pitch, self.mirror.working_radius)

    def measurement_of(self, sag: Floats) -> Measurement:
        """Fit and sample a map: the same steps as `dm_calibration.acquisition.ingest.Ingest`, without a file."""
        aperture = self.aperture
        valid = np.isfinite(sag)
        if self._fitter is None or not self._fitter.fits(valid, aperture):
            self._fitter = MapFitter(valid, aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
        fit = self._fitter.fit(sag)
        samples = sample_map(sag, aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px, self._points)
        return Measurement(
            points=self._points,
            sag=samples,
            coefficients=fit.coefficients,
            sigma=fit.sigma,
            stamp_ns=round(self.time * 1e9),
            moved_ns=round(self._moved * 1e9),
            residual_rms=fit.residual_rms,
            valid_fraction=fit.valid_fraction,
            radius=aperture.radius_px * self.pitch,
            wavelength=self._interferometer.config.wavelength,
        )

    def true_influence(self) -> tuple[Floats, Floats]:
        """(V, N) m per m of base displacement at the valid pixels, and the initial figure (V,) m: for judging only."""
        count = len(self.plate.x)
        inside = self._interferometer.aperture
        figure = self._interferometer.true_sag(np.zeros(count))[inside]
        columns = [self._interferometer.true_sag(unit)[inside] - figure for unit in np.eye(count)]
        return np.column_stack(columns), figure

    @property
    def true_displacement(self) -> Floats:
        """(N,) base displacements at this moment, m: for judging only."""
        self.piezo.advance(self.time)
        return np.asarray(self.piezo.displacement)

    @property
    def true_stroke(self) -> Floats:
        """(N,) largest base displacement from mid range of each actuator, m: for judging only."""
        config = self.piezo.config
        return np.asarray(0.5 * config.stroke * self.piezo.gain)

    # --- calibration ---

    def calibrate(
        self,
        kind: PlanKind = PlanKind.FULL,
        plan_options: PlanOptions | None = None,
        options: ProcedureOptions | None = None,
        *,
        model: LinearModel | None = None,
        progress: Callable[[Progress], None] = lambda progress: None,
    ) -> Calibration:
        """Run a plan and fit it, as the node `calibration` does, and go back to mid range.

        Raises:
            TooFewMapsError, Refusal, ValueError: as `Procedure` and `dm_calibration.calibrator.calibrate`.
        """
        options = options or ProcedureOptions()
        plan = make_plan(kind, self.mirror, plan_options)
        procedure = Procedure(plan, self.mirror, self, options, model=model, progress=progress)
        try:
            procedure.run()
        finally:
            self.apply(self.mirror.rest)
        provenance = Provenance(f"{self.mirror.serial}-{self.config.law}", round(self.time * 1e9))
        return calibrate(procedure.outcome, mirror=self.mirror, options=options.fit, provenance=provenance)


def plan_steps(kind: PlanKind = PlanKind.FULL, options: PlanOptions | None = None) -> int:
    """Steps of a plan on the simulation's mirror, for progress bars."""
    plate = Plate(PlateConfig())
    limits = Limits(pairs=neighbour_pairs(plate.x, plate.y))
    mirror = Mirror("PDM30-37", "", plate.x, plate.y, InterferometerConfig().field_diameter / 2, limits)
    return len(make_plan(kind, mirror, options).steps)


def influence_model(fit: InfluenceFit, aperture_radius: float) -> InfluenceModel:
    """The model that the focus controller would make of a calibration's message."""
    return InfluenceModel(
        aperture_radius=aperture_radius,
        influence_zernike=fit.influence_zernike,
        zernike_offset=fit.zernike_offset,
        points=fit.points,
        influence_sag=fit.influence_sag,
        sag_offset=fit.sag_offset,
        held_out_rms=fit.held_out_rms,
        held_out_max_zernike=fit.held_out_max_zernike,
    )


__all__ = ["Floats", "SimulatedBench", "SimulationConfig", "influence_model", "plan_steps"]
