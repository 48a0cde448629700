"""From a map file to the figures the suite works with: oriented map, aperture, Zernike fit, samples. Knows no ROS."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dm_calibration.map_files import SurfaceMap, read_map
from dm_calibration.optics.aperture import Aperture, InsufficientDataError, configured_aperture, find_aperture
from dm_calibration.optics.map_fit import MapFit, MapFitter
from dm_calibration.optics.orientation import Orientation
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sampling import SamplePoints, edge_clustered_points, sample_map


class MapRejectedError(Exception):
    """A readable map that does not belong to this bench: another wavelength or setting."""


@dataclass(frozen=True)
class IngestSettings:
    """How maps are read and judged.

    Attributes:
        xyz_unit: unit of `.xyz` values; "" = refuse them.
        pitch: m per pixel for files that do not tell it; 0 = unknown.
        wavelength: expected, m; 0 = any.
        wavelength_tolerance: m.
        orientation: from the instrument's picture to the mirror frame.
        aperture_radius: m; 0 = find the aperture from the valid pixels.
        aperture_centre: (x, y) in m from the oriented map's centre, used with aperture_radius.
        minimum_valid_fraction: valid pixels / pixels inside the aperture.
        remove_piston_tilt: subtract the map's plane from the map that is handed on; the fit keeps piston and tilt.
    """

    xyz_unit: str = ""
    pitch: float = 0.0
    wavelength: float = 0.0
    wavelength_tolerance: float = 1e-9
    orientation: Orientation = field(default_factory=Orientation)
    aperture_radius: float = 0.0
    aperture_centre: tuple[float, float] = (0.0, 0.0)
    minimum_valid_fraction: float = 0.7
    remove_piston_tilt: bool = False


@dataclass(frozen=True, eq=False)
class Measurement:
    """One map and what was made of it.

    Attributes:
        source: the map as read; its sag is in the instrument's orientation.
        sag: (height, width), m, oriented; NaN = no data.
        pitch: m per pixel; None = unknown.
        aperture: on the oriented map.
        fit: coefficients in m, piston and tilt included.
        points: where `samples` were taken.
        samples: (P,), m, piston and tilt included; NaN = no valid pixel.
        piston_tilt_removed: whether `sag` has its plane subtracted.
        valid: (height, width), pixels with data.
    """

    source: SurfaceMap
    sag: NDArray[np.float64]
    pitch: float | None
    aperture: Aperture
    fit: MapFit
    points: SamplePoints
    samples: NDArray[np.float64]
    piston_tilt_removed: bool
    valid: NDArray[np.bool_]

    @property
    def pv(self) -> float:
        """m, peak to valley of `sag` over all its valid pixels."""
        return self._spread[0]

    @property
    def rms(self) -> float:
        """m, standard deviation of the same."""
        return self._spread[1]

    @cached_property
    def _spread(self) -> tuple[float, float]:
        """Found when first asked for: coefficients need not wait for it."""
        heights = self.sag[self.valid]
        extent = float(np.ptp(heights))
        heights -= heights.mean()
        return extent, float(np.sqrt(heights @ heights / heights.size))

    @property
    def aperture_radius(self) -> float | None:
        """m; None without a pitch."""
        return None if self.pitch is None else self.aperture.radius_px * self.pitch

    @property
    def aperture_centre(self) -> tuple[float, float]:
        """(x, y) of the aperture in m from the map's centre, y up; zeros without a pitch."""
        if self.pitch is None:
            return (0.0, 0.0)
        height, width = self.sag.shape
        return (
            (self.aperture.centre_x_px - (width - 1) / 2) * self.pitch,
            ((height - 1) / 2 - self.aperture.centre_y_px) * self.pitch,
        )


class Ingest:
    """Reads and fits map files, one at a time however many threads ask, so that memory stays flat."""

    def __init__(self, sample_count: int = 500) -> None:
        self.points = edge_clustered_points(sample_count)
        self._turn = threading.Lock()
        self._fitter: MapFitter | None = None  # of the last mask: dropouts often stay where they are

    def read(self, path: Path, settings: IngestSettings) -> Measurement:
        """Read, orient and fit one file.

        Raises:
            MapFileError: the file is not a whole, readable map.
            InsufficientDataError, NoValidPixelsError: too few valid pixels.
            MapRejectedError: another wavelength than expected, or an aperture in m for a map without a pitch.
        """
        with self._turn:
            source = read_map(path, xyz_unit=settings.xyz_unit or None)
            try:
                return self._measure(source, settings)
            except (InsufficientDataError, MapRejectedError) as error:
                raise type(error)(f"{path}: {error}") from error

    def _measure(self, source: SurfaceMap, settings: IngestSettings) -> Measurement:
        difference = abs(source.wavelength - settings.wavelength)
        if settings.wavelength and difference > settings.wavelength_tolerance:
            raise MapRejectedError(
                f"wavelength = {source.wavelength * 1e9:.3f} nm: must be {settings.wavelength * 1e9:.3f} nm within "
                f"{settings.wavelength_tolerance * 1e9:g} nm (parameters wavelength.expected, wavelength.tolerance)"
            )
        pitch = source.pitch or settings.pitch or None
        sag = settings.orientation.apply(source.sag)
        valid = np.isfinite(sag)
        aperture = self._aperture(valid, pitch, settings)
        if self._fitter is None or not self._fitter.fits(valid, aperture):
            self._fitter = None  # not two workspaces at a time
            self._fitter = MapFitter(valid, aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
        if self._fitter.valid_fraction < settings.minimum_valid_fraction:
            raise InsufficientDataError(
                f"valid fraction = {self._fitter.valid_fraction:.3f} of the aperture (radius {aperture.radius_px:.1f} "
                f"pixels): must be at least {settings.minimum_valid_fraction:g} "
                "(parameter aperture.minimum_valid_fraction)"
            )
        fit = self._fitter.fit(sag)
        samples = sample_map(sag, aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px, self.points)
        if settings.remove_piston_tilt:
            sag = remove_piston_tilt(sag)
        return Measurement(
            source=source,
            sag=sag,
            pitch=pitch,
            aperture=aperture,
            fit=fit,
            points=self.points,
            samples=samples,
            piston_tilt_removed=settings.remove_piston_tilt,
            valid=valid,
        )

    @staticmethod
    def _aperture(valid: NDArray[np.bool_], pitch: float | None, settings: IngestSettings) -> Aperture:
        if settings.aperture_radius == 0:
            return find_aperture(valid)
        if pitch is None:
            raise MapRejectedError(
                f"aperture.radius = {settings.aperture_radius:g} m, but the file does not tell its lateral resolution: "
                "set the parameter pitch, or aperture.radius to 0"
            )
        return configured_aperture(
            valid.shape,
            pitch,
            settings.aperture_radius,
            *settings.aperture_centre,
        )
