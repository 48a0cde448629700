"""Reading of a map file: oriented map, aperture, Zernike fit and samples. Independent of ROS."""

import threading
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np

from dm_calibration.map_files import XYZ_UNITS, SurfaceMap, read_map
from dm_calibration.map_files.surface_map import PITCH_MAX
from dm_calibration.optics.aperture import Aperture, InsufficientDataError, MapRejectedError, find_aperture
from dm_calibration.optics.instrument import undistorted, without_retrace
from dm_calibration.optics.map_fit import MapFitter
from dm_calibration.optics.orientation import Orientation
from dm_calibration.optics.phase_steps import mend_phase_steps
from dm_common import Bools
from dm_common.errors import beside
from dm_common.measurement import Measurement
from dm_common.optics.piston_tilt import remove_plane
from dm_common.optics.sampling import edge_clustered_points, sample_map
from dm_common.optics.zernike import basis
from dm_common.values import live_parameter, parameter, real, reals, switch, text

#: Maps are searched for phase steps if the fit leaves more than this at a sampling point, in wavelengths. A step of one
#: fringe leaves more at its edge; it is missed only if its region lies between the sampling points.
STEP_SHARE = 0.125
#: Relative difference of pitch from which a file is taken to come from another zoom setting.
ZOOM_SHARE = 0.05


@dataclass(frozen=True)
class IngestSettings:
    """How maps are read and judged.

    Attributes:
        orientation: from the instrument's picture to the mirror frame.
        mirror_radius: m, upper limit of aperture_radius; 0 = not known.
        aperture_centre: (x, y) in m from the oriented map's centre, used with aperture_radius.
        reference: the instrument's own error, subtracted from every map before orientation; None = not known.
    """

    orientation: Orientation = field(default_factory=Orientation)
    mirror_radius: float = 0.0
    aperture_centre: tuple[float, float] = (0.0, 0.0)
    reference: SurfaceMap | None = None
    aperture_radius: float = live_parameter(
        real(0.0, 0.0, 1.0, "m"),
        "Radius of the aperture; 0 = find the aperture from the valid region of each map.",
        name="aperture.radius",
    )
    aperture_follow: bool = live_parameter(
        switch(False),
        "Measure aperture.centre_x and centre_y from the centre of the valid region, found anew in each map. For valid "
        "regions that end at the rim of the mirror or of a mask on it.",
        name="aperture.follow",
    )
    valid_fraction_min: float = live_parameter(
        real(0.7, 0.0, 1.0),
        "Smallest share of valid pixels in the aperture for a map to be published; maps with fewer are refused.",
        name="aperture.valid_fraction_min",
    )
    wavelength: float = live_parameter(
        real(0.0, 0.0, 2e-5, "m"),
        "Wavelength of the instrument; maps of another wavelength are refused. 0 = any.",
        name="wavelength.expected",
    )
    wavelength_tolerance: float = live_parameter(
        real(1e-9, 0.0, 1e-6, "m"), "Allowed deviation from wavelength.expected.", name="wavelength.tolerance"
    )
    pitch: float = live_parameter(
        real(0.0, 0.0, PITCH_MAX, "m"),
        "Lateral resolution per pixel, as found by `./dm measure --reference-sphere METRES`; files that state a value "
        "more than 5 % off are refused. 0 = as stated in the file.",
    )
    # Corrected in every map after `reference` is subtracted; see `dm_calibration.optics.instrument`.
    retrace: tuple[float, ...] = parameter(
        reals([], -1.0, 1.0),
        "Retrace error, proportional to tilt: 36 numbers from `./dm instrument retrace FILES`; empty = none.",
    )
    distortion: float = parameter(
        real(0.0, -0.1, 0.1),
        "Relative radial distortion at the edge of the map, from `./dm instrument grid MARKS.csv MAP`.",
    )
    instrument_error: float = live_parameter(
        real(0.0, 0.0, 1e-6, "m"),
        "95 % bound on the remaining instrument error in any coefficient, for the absolute accuracy that results "
        "state. 0 = not known.",
    )
    scale_error: float = live_parameter(
        real(0.0, 0.0, 0.1),
        "95 % bound on the relative error of the lateral scale, for the absolute accuracy; 0 = not known.",
    )
    xyz_unit: str = live_parameter(
        text("", choices=("", *XYZ_UNITS)),
        "Unit of the values in .xyz files, which do not state it, and in .fits files without BUNIT; empty = refuse "
        "such files.",
    )
    remove_piston_tilt: bool = live_parameter(
        switch(False), "Subtract piston and tilt from the published map; coefficients and samples keep them."
    )

    @property
    def corrections(self) -> str:
        """The instrument errors that are subtracted, as text to store with the maps; "" = none."""
        parts = []
        if self.reference is not None:
            parts.append(f"{Path(self.reference.file).name}, SHA-256 {self.reference.sha256}")
        if self.retrace:
            parts.append(f"retrace error of {max(map(abs, self.retrace)) * 1e3:.4g} nm per um of tilt")
        if self.distortion:
            parts.append(f"distortion of {self.distortion:.4%}")
        return "; ".join(parts)


def too_large(radius: float, mirror_radius: float) -> str:
    """A sentence if the configured aperture is larger than the mirror, else ""; m, mirror_radius 0 = not known."""
    if not radius > mirror_radius > 0.0:
        return ""
    return f"aperture.radius = {radius:g} m: the mirror has a radius of {mirror_radius:g} m (mirror_info)"


class Ingest:
    """Reads and fits map files, one at a time even for several threads, so that memory use stays constant."""

    def __init__(self, sample_count: int = 500) -> None:
        self.points = edge_clustered_points(sample_count)
        self._terms = basis(self.points.x, self.points.y)
        self._turn = threading.Lock()
        self._fitter: MapFitter | None = None  # for the last mask, which often repeats: dropouts tend to stay in place

    def read(self, path: Path, settings: IngestSettings) -> tuple[SurfaceMap, Measurement]:
        """Read, orient and fit one file: returns the oriented map and its measurement.

        Coefficients and samples include piston and tilt. The measurement lacks the digest of the file, which is
        :attr:`SurfaceMap.sha256`, and its time stamp.

        Raises:
            MapFileError: the file is not a whole, readable map.
            InsufficientDataError, NoValidPixelsError: too few valid pixels.
            MapRejectedError: another wavelength than expected, other settings than the reference surface, an aperture
                in m for a map without a pitch, an aperture larger than the mirror, or a region that is off by a
                non-integer number of fringes.
        """
        with self._turn:
            source = read_map(path, xyz_unit=settings.xyz_unit or None)
            try:
                return self._measure(source, settings)
            except (InsufficientDataError, MapRejectedError) as error:
                raise type(error)(f"{source.file}: {error}") from error

    def measure(self, source: SurfaceMap, settings: IngestSettings) -> tuple[SurfaceMap, Measurement]:
        """Orient and fit a map that was read. Raises as :meth:`read`."""
        with self._turn:
            return self._measure(source, settings)

    def _measure(self, source: SurfaceMap, settings: IngestSettings) -> tuple[SurfaceMap, Measurement]:
        if not source.wavelength:  # not given in the file
            source = replace(source, wavelength=settings.wavelength)
        if settings.wavelength and abs(source.wavelength - settings.wavelength) > settings.wavelength_tolerance:
            raise MapRejectedError(
                f"wavelength = {source.wavelength * 1e9:.3f} nm: must be {settings.wavelength * 1e9:.3f} nm within "
                f"{settings.wavelength_tolerance * 1e9:g} nm (parameters wavelength.expected, wavelength.tolerance)"
            )
        if source.pitch and settings.pitch and abs(source.pitch - settings.pitch) > ZOOM_SHARE * settings.pitch:
            raise MapRejectedError(
                f"pitch of the file = {source.pitch * 1e6:.3f} um: must be {settings.pitch * 1e6:.3f} um within "
                f"{ZOOM_SHARE:.0%} (parameter pitch): another zoom?"
            )
        pitch = settings.pitch or source.pitch
        sag, subtracted = source.sag, source.system_error_subtracted
        if settings.reference is not None:
            if different := source.difference(settings.reference, settings.pitch, settings.wavelength_tolerance):
                raise MapRejectedError(different)
            sag, subtracted = sag - settings.reference.sag, True
        if settings.retrace:
            sag = without_retrace(sag, settings.retrace)
        if settings.distortion:
            sag = undistorted(sag, settings.distortion)
        sag = settings.orientation.apply(sag)
        surface = replace(source, sag=sag, pitch=pitch)
        aperture, followed = self._aperture(surface.valid, pitch, settings)
        circle = (aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
        if self._fitter is None or not self._fitter.fits(surface.valid, aperture):
            self._fitter = None  # free it first: two workspaces would double the memory
            self._fitter = MapFitter(surface.valid, *circle)
        if self._fitter.valid_fraction < (least := settings.valid_fraction_min):
            raise InsufficientDataError(
                f"valid fraction = {beside('.3f', self._fitter.valid_fraction, least)} of the aperture (radius "
                f"{aperture.radius_px:.1f} pixels): must be at least {least:g} (parameter aperture.valid_fraction_min)"
            )
        fit = self._fitter.fit(sag)
        samples = sample_map(sag, *circle, self.points)
        left = np.abs(samples - self._terms @ fit.coefficients)
        if not source.phase_steps and np.fmax.reduce(left) > STEP_SHARE * source.wavelength > 0.0:
            mended, regions = mend_phase_steps(source.sag, 0.5 * source.wavelength)
            if regions:
                return self._measure(replace(source, sag=mended, phase_steps=regions), settings)
        measured = Measurement(
            points=self.points,
            sag=samples,
            coefficients=fit.coefficients,
            sigma=fit.sigma,
            stamp_ns=0,
            residual_rms=fit.residual_rms,
            valid_fraction=fit.valid_fraction,
            radius=aperture.radius_px * (pitch or 0.0),
            wavelength=source.wavelength,
            system_error_subtracted=-1 if subtracted is None else int(subtracted),
            reference_surface=settings.corrections,
            instrument_error=settings.instrument_error,
            scale_error=settings.scale_error,
            file=source.file,
            instrument=f"{source.instrument}, serial {source.serial}" if source.serial else source.instrument,
            pitch=pitch or 0.0,
            camera=(sag.shape[1], sag.shape[0]),
            centre=circle[:2],
            followed=followed,
            radius_px=aperture.radius_px,
            orientation=astuple(settings.orientation),
        )
        if settings.remove_piston_tilt:
            surface = replace(surface, sag=remove_plane(sag), piston_tilt_removed=True)
        return surface, measured

    @staticmethod
    def _aperture(valid: Bools, pitch: float | None, settings: IngestSettings) -> tuple[Aperture, tuple[float, float]]:
        """The aperture, and the value of `Measurement.followed`."""
        nothing = (0.0, 0.0)
        if settings.aperture_radius == 0:
            return find_aperture(valid), nothing
        if wrong := too_large(settings.aperture_radius, settings.mirror_radius):
            raise MapRejectedError(wrong)
        if pitch is None:
            raise MapRejectedError(
                f"aperture.radius = {settings.aperture_radius:g} m, but the file states no lateral resolution: set "
                "the parameter pitch, or aperture.radius to 0"
            )
        wanted = Aperture.configured(valid.shape, pitch, settings.aperture_radius, *settings.aperture_centre)
        if not settings.aperture_follow:
            return wanted, nothing
        seen = find_aperture(valid)
        if seen.radius_px < wanted.radius_px:
            raise MapRejectedError(
                f"aperture.follow: the valid region has a radius of {seen.radius_px * pitch:g} m, must be at least "
                f"aperture.radius = {settings.aperture_radius:g} m"
            )
        height, width = valid.shape
        shift_x, shift_y = seen.centre_x_px - 0.5 * (width - 1), seen.centre_y_px - 0.5 * (height - 1)
        moved = replace(wanted, centre_x_px=wanted.centre_x_px + shift_x, centre_y_px=wanted.centre_y_px + shift_y)
        return moved, (seen.centre_x_px, seen.centre_y_px)
