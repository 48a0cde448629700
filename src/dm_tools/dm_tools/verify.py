"""Compare a measured surface with the requested one."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.images import pixels_of
from dm_calibration.optics.aperture import Aperture
from dm_calibration.optics.map_fit import MapFitter
from dm_common import Floats
from dm_common.optics.piston_tilt import remove_plane
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
    aperture = Aperture(info.centre_x, info.centre_y, info.aperture_radius_px)
    place = aperture.places(*np.indices(sag.shape))
    wanted = target.sag(place.real, place.imag, info.aperture_radius)
    error = np.where(aperture.disc(sag.shape), sag - wanted, np.nan)
    fit = MapFitter(np.isfinite(error), info.centre_x, info.centre_y, info.aperture_radius_px).fit(error)
    residual = remove_plane(error)
    return SurfaceError(residual, float(np.nanstd(residual)), float(np.abs(fit.coefficients[PISTON_TILT:]).max()))
