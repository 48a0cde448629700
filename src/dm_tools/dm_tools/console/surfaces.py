"""Surfaces on one grid over the aperture: the measured one, the predicted one and their difference."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter

from dm_common import Bools, Floats
from dm_common.optics.piston_tilt import remove_plane
from dm_common.optics.sampling import on_disc
from dm_controller.planning.active_calibration import model_of

#: Points of the grid along each side. Finer than the print-through of the actuators, coarse enough for a phone.
GRID = 101
#: Share of the aperture's radius that is shown: beyond it, pixels lie on one side of a point only.
SHOWN = 0.985
#: Share of a point's pixels that must be valid.
VALID_SHARE = 0.6
#: Relative difference of two aperture radii below which maps are compared point by point.
RADIUS_TOLERANCE = 0.02


@lru_cache(maxsize=1)
def _disc() -> tuple[Floats, Floats, Bools]:
    """x and y of the grid in units of the radius, row 0 = top, and which points are shown."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, GRID), np.linspace(1.0, -1.0, GRID))
    return x, y, x**2 + y**2 <= SHOWN**2


@dataclass(frozen=True, eq=False)
class Surface:
    """Sag over the aperture, piston and tilt removed; at least one point is known.

    Attributes:
        sag: (GRID, GRID) m, row 0 = top, NaN = no data or outside the aperture.
        radius: m, of the aperture; 0 = not known.
    """

    sag: Floats
    radius: float

    @cached_property
    def peak_to_valley(self) -> float:
        """In m."""
        return float(np.nanmax(self.sag) - np.nanmin(self.sag))

    @cached_property
    def rms(self) -> float:
        """In m."""
        return float(np.nanstd(self.sag))

    @cached_property
    def extent(self) -> float:
        """Largest magnitude, m."""
        return float(np.nanmax(np.abs(self.sag)))


def measured_surface(sag: NDArray[np.floating[Any]], info: Any) -> Surface:
    """Resample a map on the grid: means over the pixels around each point.

    Points with a smaller valid share than `VALID_SHARE` become NaN: a mean over one side would be off by the slope.

    Args:
        sag: (H, W) m, row 0 = top, NaN = no data.

    Raises:
        ValueError: the aperture radius of the map is not positive, or no pixel of the aperture is valid.
    """
    radius = info.aperture_radius_px
    if not radius > 0:
        raise ValueError(f"surface_map_info: aperture_radius_px = {radius:g}: must be positive")
    x, y, shown = _disc()
    places = info.centre_y - radius * y, info.centre_x + radius * x
    around = 2 * round(radius / (GRID - 1)) + 1  # odd, so that the window is centred on the point
    valid = np.isfinite(sag)
    share, mean = (
        map_coordinates(uniform_filter(values.astype(np.float32), around, mode="constant"), places, order=1)
        for values in (valid, np.where(valid, sag, 0.0))
    )
    enough = shown & (share >= VALID_SHARE)
    mean = np.where(enough, mean / np.where(enough, share, 1.0), np.nan)
    return Surface(remove_plane(mean.astype(np.float64)), info.aperture_radius)


class SurfaceModel:
    """The surface that a calibration predicts, on the grid. Shapes: N actuators, K terms.

    Raises ValueError, naming the field, for arrays of the calibration that do not fit together.
    """

    def __init__(self, calibration: Any) -> None:
        self._model = model = model_of(calibration)
        self.actuators = calibration.actuators
        self._sag = on_disc(np.vstack([model.influence_sag.T, model.sag_offset]), model.points, GRID)

    def surface(self, effective: Floats) -> Surface:
        """The surface under the effective signals (N,)."""
        sag = (np.tensordot(effective, self._sag[:-1], 1) + self._sag[-1])[::-1]  # row 0 = top
        return Surface(remove_plane(np.where(_disc()[2], sag, np.nan)), self._model.aperture_radius)

    def coefficients(self, effective: Floats) -> Floats:
        """(K,) m under the effective signals (N,)."""
        return np.asarray(self._model.influence_zernike @ effective + self._model.zernike_offset)


def difference(measured: Surface, predicted: Surface) -> Surface:
    """Measured minus predicted. Raises ValueError when the apertures differ."""
    gap = abs(measured.radius - predicted.radius)
    if measured.radius > 0 and gap > RADIUS_TOLERANCE * predicted.radius:
        raise ValueError(
            f"the map's aperture radius is {measured.radius * 1e3:.2f} mm, that of the calibration "
            f"{predicted.radius * 1e3:.2f} mm: they cannot be compared"
        )
    return Surface(remove_plane(measured.sag - predicted.sag), predicted.radius)
