"""Compare a measured surface with the requested one."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.images import pixels_of
from dm_calibration.optics.map_fit import MapFitter
from dm_common import Floats
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.target import FocusTarget


@dataclass(frozen=True)
class SurfaceError:
    """Measured minus wanted surface, piston and tilt removed.

    Attributes:
        residual: (H, W) m, NaN outside the aperture and where there are no data.
        rms: m, over the valid pixels of the aperture.
        max_zernike: m, largest coefficient error beyond tilt.
    """

    residual: Floats
    rms: float
    max_zernike: float


def map_of(image: Any) -> NDArray[np.float32]:
    """The sag (H, W) [m] of a sensor_msgs/Image. Raises ValueError when it is no surface map or is inconsistent."""
    if image.encoding != "32FC1":
        raise ValueError(f"encoding = {image.encoding!r}: a surface map is 32FC1")
    return pixels_of(image)[..., 0]


def surface_error(sag: NDArray[np.floating[Any]], info: Any, target: FocusTarget) -> SurfaceError:
    """Judge a map (row 0 = top) with its dm_msgs/SurfaceMapInfo against a target over the map's aperture.

    Raises ValueError when the map has no lateral resolution, so that a curvature means nothing.
    """
    if not info.aperture_radius > 0:
        raise ValueError("the map has no lateral resolution: set the interferometer's parameter `pitch`")
    x = (np.arange(sag.shape[1]) - info.centre_x) / info.aperture_radius_px
    y = (info.centre_y - np.arange(sag.shape[0])) / info.aperture_radius_px
    grid_x, grid_y = np.meshgrid(x, y)
    inside = grid_x**2 + grid_y**2 <= 1.0
    error = np.where(inside, sag - target.sag(grid_x, grid_y, info.aperture_radius), np.nan)
    fit = MapFitter(np.isfinite(error), info.centre_x, info.centre_y, info.aperture_radius_px).fit(error)
    # The first three terms are piston and the tilts, in x and y.
    residual = error - (fit.coefficients[0] + fit.coefficients[1] * grid_x + fit.coefficients[2] * grid_y)
    residual -= np.nanmean(residual)
    return SurfaceError(
        residual=residual,
        rms=float(np.sqrt(np.nanmean(residual**2))),
        max_zernike=float(np.abs(fit.coefficients[PISTON_TILT:]).max()),
    )
