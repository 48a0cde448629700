"""The calibration procedure: go through a plan, command, settle, measure, and lose no good map to a bad one.

It knows no ROS: what moves the mirror and what measures it are callables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.maps import MapRecord, MapSet, same_points
from dm_calibration.influence.mirror import Mirror
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.surfaces import LinearModel
from dm_calibration.optics.sampling import SamplePoints
from dm_calibration.plan import Plan, Step, StepKind, solve_step

Floats = NDArray[np.float64]

#: Value of dm_msgs/ErrorCode.MAP_REJECTED.
MAP_REJECTED = 305


@dataclass(frozen=True)
class Measurement:
    """One map as the interferometer gives it; fields as in :class:`~dm_calibration.influence.maps.MapRecord`.

    Attributes:
        radius: of the aperture the coefficients and points are normalised to, m; 0 = unknown.
        wavelength: m; 0 = unknown.
        system_error_subtracted: 1 yes, 0 no, -1 not told.
        moved_ns: when the mirror took the shape, ns; 0 = not told.
    """

    points: SamplePoints
    sag: Floats
    coefficients: Floats
    sigma: Floats
    stamp_ns: int
    residual_rms: float
    valid_fraction: float
    radius: float = 0.0
    wavelength: float = 0.0
    system_error_subtracted: int = -1
    file: str = ""
    sha256: str = ""
    moved_ns: int = 0


class BenchError(Exception):
    """The mirror or the interferometer failed; `code` is a value of dm_msgs/ErrorCode."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class MeasurementError(BenchError):
    """One map could not be had; another try may succeed."""


class Cancelled(Exception):
    """The procedure was asked to stop."""


class Bench(Protocol):
    """What the procedure drives."""

    def degauss(self) -> None:
        """Wipe the hysteresis memory and end at rest. Raises BenchError."""

    def apply(self, signals: Floats) -> Floats:
        """Command `signals` (N,), wait until they stand, return what was written (N,). Raises BenchError."""

    def settle(self, dwell: float = 0.0) -> bool:
        """Wait the settle time and `dwell` s more; False when cancelled meanwhile."""

    def measure(self, label: str) -> Measurement:
        """Take one map. Raises MeasurementError, or BenchError when no other try can succeed."""


@dataclass(frozen=True)
class Progress:
    """Where the procedure stands: step `done` of `steps`."""

    label: str
    kind: StepKind
    done: int
    steps: int
    dropped: int
    residual_rms: float


@dataclass(frozen=True)
class ProcedureOptions:
    """Tries and checks of the measurements.

    Attributes:
        measure_retries: further tries after a measurement that failed.
        failures_max: states in a row without a map after which the run is given up.
        maps_per_state: maps taken in each commanded state.
        aperture_tolerance: largest relative deviation of a map's aperture radius from the mirror's.
        wavelength_tolerance: largest relative difference of wavelengths between maps.
        fit: options of the fit that the surfaces with a prescribed shape are solved from.
    """

    measure_retries: int = 1
    failures_max: int = 3
    maps_per_state: int = 1
    aperture_tolerance: float = 0.02
    wavelength_tolerance: float = 1e-4
    fit: FitOptions = field(default_factory=FitOptions)


@dataclass
class Outcome:
    """What a run has measured so far.

    Attributes:
        records: the maps, in order.
        points: the sampling points of all of them; None before the first.
        wavelength: m; 0 = unknown.
        system_error_subtracted: as in Measurement, the same for all maps.
        radius_known: whether the maps tell their aperture radius.
        dropped: "label: reason" of each map or state that gave none.
        remarks: what was measured differently than asked.
        targets: the shapes that were solved, in words.
    """

    records: list[MapRecord] = field(default_factory=list)
    points: SamplePoints | None = None
    wavelength: float = 0.0
    system_error_subtracted: int = -1
    radius_known: bool = True
    dropped: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    targets: list[str] = field(default_factory=list)

    def maps(self) -> MapSet:
        """All maps measured.

        Raises:
            TooFewMapsError: there is none.
        """
        if self.points is None or not self.records:
            raise TooFewMapsError("no map was measured; " + "; ".join(self.dropped[:3]))
        return MapSet.from_records(self.records, self.points)


class Procedure:
    """One run of a plan on a bench. `outcome` can be read at any time, also after a failure."""

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
    ) -> None:
        """`model` solves the surfaces with a prescribed shape; None = one fitted to the maps of this run so far."""
        self.outcome = Outcome(remarks=list(plan.remarks))
        self._plan, self._mirror, self._bench = plan, mirror, bench
        self._options = options or ProcedureOptions()
        self._model = model
        self._progress, self._cancelled = progress, cancelled
        self._failures = 0

    def run(self) -> Outcome:
        """Go through all steps.

        The caller brings the mirror back to rest afterwards, however this ends.

        Raises:
            Cancelled: `cancelled()` became true; noticed within one step.
            BenchError: the mirror failed, or the interferometer gave no map for several states in a row.
        """
        steps = self._plan.steps
        for number, planned in enumerate(steps):
            self._stop_if_cancelled()
            residual_rms = self.outcome.records[-1].residual_rms if self.outcome.records else 0.0
            self._report(planned, number, residual_rms)
            if planned.kind is StepKind.DEGAUSS:
                self._bench.degauss()
                continue
            step = self._solved(planned)
            if step is not None:
                self._measure_state(step, number)
        self._report(steps[-1], len(steps), self.outcome.records[-1].residual_rms if self.outcome.records else 0.0)
        return self.outcome

    def _report(self, step: Step, done: int, residual_rms: float) -> None:
        self._progress(
            Progress(step.label, step.kind, done, len(self._plan.steps), len(self.outcome.dropped), residual_rms)
        )

    def _stop_if_cancelled(self) -> None:
        if self._cancelled():
            raise Cancelled("cancelled")

    def _solved(self, step: Step) -> Step | None:
        """`step` with its signals; None, with the reason in `dropped`, when no model can be had."""
        if not step.needs_model:
            return step
        try:
            if self._model is None:
                self._model = fit_influence(self.outcome.maps(), self._options.fit, rings=self._mirror.rings)
            solved, surface = solve_step(step, self._model, self._mirror)
        except TooFewMapsError as error:
            self.outcome.dropped.append(f"{step.label}: no influence function to solve its signals from: {error}")
            return None
        self.outcome.targets.append(surface.target)
        if surface.remark:
            self.outcome.remarks.append(surface.remark)
        return solved

    def _measure_state(self, step: Step, number: int) -> None:
        assert step.signals is not None
        applied = self._bench.apply(step.signals)
        if not self._bench.settle(step.dwell):
            raise Cancelled("cancelled while settling")
        taken = 0
        failure = MeasurementError(MAP_REJECTED, "")
        for repeat in range(self._options.maps_per_state):
            label = step.label if repeat == 0 else f"{step.label} ({repeat + 1})"
            try:
                self.outcome.records.append(self._record(label, step, number, applied))
                taken += 1
            except MeasurementError as error:
                self.outcome.dropped.append(f"{label}: {error}")
                failure = error
        if not taken:
            self._note_unseen(step, number, applied)
        self._failures = 0 if taken else self._failures + 1
        if self._failures >= self._options.failures_max:
            raise BenchError(failure.code, f"{self._failures} states in a row gave no map; the last: {failure}")

    def _note_unseen(self, step: Step, number: int, applied: Floats) -> None:
        """Keep a command without a map where the actuators' memory is to be identified: they remember it all the same.

        Its time is not known; it counts as right after the map before.
        """
        records = self.outcome.records
        if step.kind not in (StepKind.EXCITATION, StepKind.CHECK) or not records:
            return
        nothing = np.full_like(records[-1].coefficients, np.nan)
        assert step.signals is not None
        records.append(
            replace(
                records[-1], label=step.label, kind=step.kind.value, step=number, signals=step.signals,
                applied=applied, coefficients=nothing, sigma=nothing, sag=np.full_like(records[-1].sag, np.nan),
                residual_rms=np.nan, valid_fraction=0.0, file="", sha256="", nominal=None, moved_ns=0,
            )
        )  # fmt: skip

    def _record(self, label: str, step: Step, number: int, applied: Floats) -> MapRecord:
        for attempt in range(self._options.measure_retries + 1):
            self._stop_if_cancelled()
            try:
                measured = self._bench.measure(label)
                self._check(measured)
                break
            except MeasurementError as error:
                if attempt == self._options.measure_retries:
                    tries = f" ({attempt + 1} tries)" if attempt else ""
                    raise MeasurementError(error.code, f"{error}{tries}") from error
        assert step.signals is not None
        return MapRecord(
            label=label,
            kind=step.kind.value,
            step=number,
            signals=step.signals,
            applied=applied,
            stamp_ns=measured.stamp_ns,
            coefficients=measured.coefficients,
            sigma=measured.sigma,
            sag=measured.sag,
            residual_rms=measured.residual_rms,
            valid_fraction=measured.valid_fraction,
            file=measured.file,
            sha256=measured.sha256,
            nominal=step.nominal,
            moved_ns=measured.moved_ns,
        )

    def _check(self, measured: Measurement) -> None:
        """Refuse a map that cannot be compared with the others."""
        if measured.radius > 0.0:
            expected = self._mirror.working_radius
            if abs(measured.radius - expected) > self._options.aperture_tolerance * expected:
                raise MeasurementError(
                    MAP_REJECTED,
                    f"aperture radius {measured.radius * 1e3:.3f} mm, the mirror's is {expected * 1e3:.3f} mm "
                    f"+-{self._options.aperture_tolerance:.1%}: never mix apertures in one fit, set the "
                    "interferometer's aperture.radius to the mirror's",
                )
        if self.outcome.points is None:
            self.outcome.points = measured.points
            self.outcome.wavelength = measured.wavelength
            self.outcome.system_error_subtracted = measured.system_error_subtracted
        elif not same_points(measured.points, self.outcome.points):
            raise MeasurementError(
                MAP_REJECTED,
                "sampled at other points than the maps before: leave the interferometer's sample_count alone in a run",
            )
        elif abs(measured.wavelength - self.outcome.wavelength) > (
            self._options.wavelength_tolerance * self.outcome.wavelength
        ):
            raise MeasurementError(
                MAP_REJECTED,
                f"wavelength {measured.wavelength * 1e9:.3f} nm, before it was {self.outcome.wavelength * 1e9:.3f} nm "
                "(0 = not told): never mix wavelengths in one fit, measure the whole run with one instrument",
            )
        elif measured.system_error_subtracted != self.outcome.system_error_subtracted:
            raise MeasurementError(MAP_REJECTED, "system error subtracted differs from the maps before: never mix them")
        elif self.outcome.records and measured.coefficients.shape != self.outcome.records[0].coefficients.shape:
            raise MeasurementError(
                MAP_REJECTED, f"{measured.coefficients.size} Zernike terms, the maps before had others"
            )
        self.outcome.radius_known &= measured.radius > 0.0
