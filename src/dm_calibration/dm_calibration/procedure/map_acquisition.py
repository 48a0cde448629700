"""One map of a commanded state: retried when it fails, compared with the others, checked for a bump."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from dm_calibration.influence.fit import FitOptions
from dm_calibration.influence.maps import StepKind, same_points
from dm_calibration.map_files.surface_map import PITCH_TOLERANCE
from dm_calibration.procedure.bump_check import BumpCheck, BumpOptions
from dm_calibration.procedure.outcome import NOWHERE, Doubted, Event, MapTaken, Outcome, Setup
from dm_calibration.procedure.plan import Step
from dm_common import Floats
from dm_common.errors import ErrorCode, MeasurementError, Refusal
from dm_common.measurement import Bench, Measurement
from dm_common.mirror import APERTURE_TOLERANCE, Mirror
from dm_common.values import live_parameter, whole

#: Largest relative difference of wavelengths between maps.
WAVELENGTH_TOLERANCE = 1e-4


@dataclass(frozen=True)
class ProcedureOptions:
    """Retries and checks of the measurements.

    Attributes:
        aperture_tolerance: largest relative deviation of a map's aperture radius from the mirror's.
        fit: options of the fit from which surfaces with a prescribed shape are solved.
        bump: largest differences between reference frames.
    """

    measure_retries: int = live_parameter(whole(1, 0, 20), "Further tries after a map that failed.")
    failures_max: int = live_parameter(
        whole(3, 1, 1000), "Number of shapes in a row without a map after which a run is given up."
    )
    maps_per_state: int = 1
    aperture_tolerance: float = APERTURE_TOLERANCE
    fit: FitOptions = field(default_factory=FitOptions)
    bump: BumpOptions = field(default_factory=BumpOptions)


class MapAcquisition:
    """Takes the maps of one run and adds them to its outcome."""

    def __init__(
        self,
        bench: Bench,
        mirror: Mirror,
        options: ProcedureOptions,
        outcome: Outcome,
        note: Callable[[Event], None],
        checkpoint: Callable[[], None],
        guard: Callable[[], None],
    ) -> None:
        """`note` gets each event; `checkpoint` is called before a map, `guard` after it; their errors end the run."""
        self._bench, self._mirror, self._options = bench, mirror, options
        self.outcome = outcome
        self._note, self._checkpoint, self._guard = note, checkpoint, guard
        self._bump = BumpCheck(options.bump, mirror.rest, mirror.limits.half_range)
        self._swung = False
        for record, centre in zip(outcome.records, outcome.centres, strict=True):
            self._bump.take(MapTaken(record, centre=centre))

    def swung(self) -> None:
        """Note that since the last map the actuators were degaussed and the mirror may have been moved or realigned."""
        self._bump.degaussed()
        self._swung = True

    def take(self, label: str, step: Step, number: int, applied: Floats) -> None:
        """Take a map of the present state.

        Args:
            number: of the state in the run.
            applied: (N,) as written.

        Raises:
            MeasurementError: every try failed.
            Refusal: a reference frame shows that the mirror was bumped, and so does a second one.
        """
        for attempt in range(self._options.measure_retries + 1):
            self._checkpoint()
            try:
                taken = self._map(label, step, number, applied)
                break
            except MeasurementError as error:
                if attempt == self._options.measure_retries:
                    tries = f" ({attempt + 1} tries)" if attempt else ""
                    raise MeasurementError(error.error_code, f"{error}{tries}") from error
        if step.kind is StepKind.REFERENCE and self._bump.change(taken, self._swung):
            taken = self._map(label, step, number, applied)  # bad map, or moved mirror: a second map decides
            if suspicion := self._bump.change(taken, self._swung):
                self._stop_bumped(label, suspicion)
        self._note(taken)
        self._bump.take(taken)
        self._swung = False

    def _stop_bumped(self, label: str, suspicion: str) -> None:
        """End the run; the maps since the last good reference frame are in doubt."""
        if self._swung:
            raise Refusal(
                ErrorCode.MAP_REJECTED,
                f"{label}: {suspicion}: the mirror does not stand as it did before the run was interrupted. Put it "
                "back, or begin anew (`dm calibrate --fresh`)",
            )
        frames = [index for index, record in enumerate(self.outcome.records) if record.kind == StepKind.REFERENCE]
        doubtful = len(self.outcome.records) - frames[-1] - 1
        self._note(Doubted(frames[-1] + 1, f"in doubt, bumped before {label}"))
        raise Refusal(
            ErrorCode.MAP_REJECTED,
            f"{label}: {suspicion}: the mirror or the interferometer was bumped. The {doubtful} maps since are in "
            "doubt; put the mirror back and start again to go on from the last good reference frame",
        )

    def _map(self, label: str, step: Step, number: int, applied: Floats) -> MapTaken:
        """Take a map that is comparable with the others."""
        measured = self._bench.measure(label)
        self._guard()
        check_comparable(measured, self.outcome, self._mirror.working_radius, self._options.aperture_tolerance)
        if self.outcome.setup is None:
            self._note(Setup.of(measured))
        assert step.signals is not None
        record = replace(
            measured,
            label=label,
            kind=step.kind.value,
            step=number,
            signals=step.signals,
            applied=applied,
            nominal=step.nominal,
            segment=self.outcome.segment,
        )
        centre = NOWHERE
        if measured.radius_px > 0.0:
            metres = self._mirror.working_radius / measured.radius_px
            centre = (measured.centre[0] * metres, measured.centre[1] * metres)
        return MapTaken(record, measured.radius > 0.0, centre)


def check_comparable(
    measured: Measurement, outcome: Outcome, working_radius: float, aperture_tolerance: float = APERTURE_TOLERANCE
) -> None:
    """Refuse a map of another aperture, wavelength, instrument or evaluation than those in `outcome`.

    Args:
        working_radius: of the mirror, m.
        aperture_tolerance: relative.

    Raises:
        MeasurementError: the message names what differs, its value, and that of the others.
    """
    if measured.radius > 0.0 and abs(measured.radius - working_radius) > aperture_tolerance * working_radius:
        different = (
            f"aperture radius {measured.radius * 1e3:.3f} mm, the mirror's is {working_radius * 1e3:.3f} mm "
            f"+-{aperture_tolerance:.1%}: never mix apertures in one fit, set the "
            "interferometer's aperture.radius to the mirror's"
        )
    else:
        different = _other_setup(measured, outcome.setup) if outcome.setup else ""
    first = outcome.records[0] if outcome.records else measured
    if not different and measured.coefficients.shape != first.coefficients.shape:
        different = f"{measured.coefficients.size} Zernike terms, the maps before had others"
    if not different and abs(measured.radius_px - first.radius_px) > aperture_tolerance * first.radius_px > 0.0:
        different = (
            f"aperture of {measured.radius_px:.1f} pixels radius, before it was {first.radius_px:.1f}: the map does "
            "not show the whole pupil, or another"
        )
    if different:
        raise MeasurementError(ErrorCode.MAP_REJECTED, different)


def _other_setup(measured: Measurement, setup: Setup) -> str:
    """How a map differs in setup from those before; "" = not at all."""
    if not same_points(measured.points, setup.points):
        return "sampled at other points than the maps before: measure the whole run with one interferometer node"
    if abs(measured.wavelength - setup.wavelength) > WAVELENGTH_TOLERANCE * setup.wavelength:
        return (
            f"wavelength {measured.wavelength * 1e9:.3f} nm, before it was {setup.wavelength * 1e9:.3f} nm "
            "(0 = not known): never mix wavelengths in one fit, measure the whole run with one instrument"
        )
    different = ""
    if measured.instrument != setup.instrument:
        different = f"instrument {measured.instrument!r}, before it was {setup.instrument!r}"
    elif measured.camera != setup.camera:
        here, before = ("{} x {}".format(*size) for size in (measured.camera, setup.camera))
        different = f"camera of {here} pixels, before it was {before}"
    elif not np.isclose(measured.pitch, setup.pitch, rtol=PITCH_TOLERANCE, atol=0.0):
        before = f"{setup.pitch * 1e6:.3f} um (0 = not known)"
        different = f"pixel pitch {measured.pitch * 1e6:.3f} um, before it was {before}"
    elif measured.orientation != setup.orientation:
        here, before = (
            "flip_x {}, flip_y {}, rotate_deg {:g}".format(*each) for each in (measured.orientation, setup.orientation)
        )
        return f"orientation {here}, before it was {before}: leave the interferometer's orientation.* alone in a run"
    if different:
        return f"{different}: never mix instruments in one fit, measure the whole run with one"
    if measured.system_error_subtracted != setup.system_error_subtracted:
        return "system error subtracted differs from the maps before: never mix them"
    if measured.reference_surface != setup.reference_surface:
        here, before = (each or "none" for each in (measured.reference_surface, setup.reference_surface))
        return f"reference_surface {here}, before it was {before}: leave it alone in a run"
    return ""
