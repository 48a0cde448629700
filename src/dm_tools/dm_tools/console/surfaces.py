"""Surfaces on one grid over the aperture: the measured one, the predicted one and their difference."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from dm_common import Floats
from dm_common.optics.piston_tilt import remove_plane
from dm_common.optics.zernike import basis
from dm_controller.planning.active_calibration import model_of

#: Points of the grid along each side. Finer than the print-through of the actuators, coarse enough for a phone.
GRID = 101
#: Share of the aperture's radius that is shown: beyond it, pixels lie on one side of a point only.
SHOWN = 0.985
#: Share of the weight of a point's pixels that must be valid.
WEIGHT_SHARE = 0.6
#: Relative difference of two aperture radii below which maps are compared point by point.
RADIUS_TOLERANCE = 0.02


@lru_cache(maxsize=1)
def _disc() -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """x and y of the grid in units of the radius, row 0 = top, and which points are shown."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, GRID), np.linspace(1.0, -1.0, GRID))
    return x, y, x**2 + y**2 <= SHOWN**2


@dataclass(frozen=True, eq=False)
class Surface:
    """Sag over the aperture, piston and tilt removed; some of it is known.

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
        """m, largest magnitude."""
        return float(np.nanmax(np.abs(self.sag)))


def measured_surface(sag: NDArray[np.floating[Any]], info: Any) -> Surface:
    """A map on the grid: means over the pixels around each point, weighted by their nearness.

    Points without `WEIGHT_SHARE` of their pixels hold no data: a mean over one side would be off by the slope.

    Args:
        sag: (H, W) m, row 0 = top, NaN = no data.

    Raises:
        ValueError: the aperture radius of the map is not positive, or no pixel of the aperture is valid.
    """
    if not info.aperture_radius_px > 0:
        raise ValueError(f"surface_map_info: aperture_radius_px = {info.aperture_radius_px:g}: must be positive")
    step = 2.0 * info.aperture_radius_px / (GRID - 1)
    valid = np.isfinite(sag)
    filled = np.where(valid, sag, 0.0).astype(np.float32)
    rows = _nearness(sag.shape[0], info.centre_y, step)
    columns = _nearness(sag.shape[1], info.centre_x, step)
    found = rows @ valid.astype(np.float32) @ columns.T
    whole = max(1.0, step) ** 2  # what the weights of one point sum to
    enough = (found >= WEIGHT_SHARE * whole) & _disc()[2]
    mean = np.where(enough, rows @ filled @ columns.T / np.where(enough, found, 1.0), np.nan)
    return Surface(remove_plane(mean.astype(np.float64)), info.aperture_radius)


def _nearness(pixels: int, centre: float, step: float) -> NDArray[np.float32]:
    """(GRID, pixels): weights that fall linearly to 0 at the next point, or at the next pixel of a coarse map.

    Unlike means over the pixels nearest to a point, they are centred on it wherever the pixels lie.
    """
    place = np.arange(pixels) - centre
    point = (np.arange(GRID)[:, None] - (GRID - 1) / 2) * step
    return np.maximum(0.0, 1.0 - np.abs(place - point) / max(1.0, step)).astype(np.float32)


class SurfaceModel:
    """What a calibration predicts, on the grid. Shapes: N actuators, K terms.

    Between the sampling points the 21 terms are exact, and what is beyond them is interpolated linearly.

    Raises ValueError, naming the field, for arrays of the calibration that do not fit together.
    """

    def __init__(self, calibration: Any) -> None:
        model = model_of(calibration)
        self.radius = model.aperture_radius
        self.actuators = calibration.actuators
        self._zernike, self._zernike_offset = model.influence_zernike, model.zernike_offset
        points = np.column_stack([model.sample_x, model.sample_y])
        values = np.column_stack([model.influence_sag, model.sag_offset])
        terms = basis(model.sample_x, model.sample_y)
        coefficients = np.linalg.lstsq(terms, values, rcond=None)[0]
        rest = values - terms @ coefficients
        x, y, inside = _disc()
        wanted = np.column_stack([x[inside], y[inside]])
        between = LinearNDInterpolator(points, rest)(wanted)
        beyond = np.isnan(between[:, 0])  # outside the outermost ring of points
        between[beyond] = NearestNDInterpolator(points, rest)(wanted[beyond])
        self._inside = inside
        self._sag = basis(wanted[:, 0], wanted[:, 1]) @ coefficients + between

    def surface(self, effective: Floats) -> Surface:
        """The surface under the effective signals (N,)."""
        sag = np.full(self._inside.shape, np.nan)
        sag[self._inside] = self._sag[:, :-1] @ effective + self._sag[:, -1]
        return Surface(remove_plane(sag), self.radius)

    def coefficients(self, effective: Floats) -> Floats:
        """(K,) m under the effective signals (N,)."""
        return np.asarray(self._zernike @ effective + self._zernike_offset)


def difference(measured: Surface, predicted: Surface) -> Surface:
    """Measured minus predicted. Raises ValueError when the apertures differ."""
    gap = abs(measured.radius - predicted.radius)
    if measured.radius > 0 and gap > RADIUS_TOLERANCE * predicted.radius:
        raise ValueError(
            f"the map's aperture radius is {measured.radius * 1e3:.2f} mm, that of the calibration "
            f"{predicted.radius * 1e3:.2f} mm: they cannot be compared"
        )
    return Surface(remove_plane(measured.sag - predicted.sag), predicted.radius)
