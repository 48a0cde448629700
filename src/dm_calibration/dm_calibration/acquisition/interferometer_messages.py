"""Maps and measurements as ROS messages."""

import array

import numpy as np
from dm_msgs.msg import SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from dm_calibration.acquisition.sensor import PIXELS, Seen, disc_terms
from dm_calibration.map_files import SurfaceMap
from dm_calibration.map_files.surface_map import HEIGHT_MAX
from dm_calibration.optics.aperture import MapRejectedError
from dm_common.measurement import Measurement
from dm_common.messages import OF_FILE, OF_FIT, doubles, taken
from dm_common.optics.zernike import BORN_WOLF, CONVENTIONS, to_born_wolf


def image_message(surface: SurfaceMap, header: Header) -> Image:
    """The map as 32FC1, metres, NaN = no data."""
    height, width = surface.sag.shape
    message = Image(header=header, height=height, width=width, encoding="32FC1", is_bigendian=0, step=4 * width)
    # An array.array is taken over without copying; any other type is checked byte by byte.
    message.data = array.array("B")
    message.data.frombytes(surface.sag.astype("<f4").data.cast("B"))
    return message


def info_message(surface: SurfaceMap, measured: Measurement, header: Header) -> SurfaceMapInfo:
    """Facts on a map from its file and from its measurement."""
    return SurfaceMapInfo(
        header=header,
        width=measured.camera[0],
        height=measured.camera[1],
        centre_x=measured.centre[0],
        centre_y=measured.centre[1],
        followed_x=measured.followed[0],
        followed_y=measured.followed[1],
        aperture_radius_px=measured.radius_px,
        aperture_radius=measured.radius,
        **taken(measured, "valid_fraction", *OF_FILE),
        **taken(surface, "pv", "rms", "piston_tilt_removed", "file", "sha256"),
        flip_x=measured.orientation[0],
        flip_y=measured.orientation[1],
        rotate_deg=measured.orientation[2],
    )


def zernike_message(measured: Measurement, header: Header) -> ZernikeCoefficients:
    """The Zernike fit."""
    return ZernikeCoefficients(
        header=header,
        convention=BORN_WOLF,
        coefficients=doubles(measured.coefficients),
        sigma=doubles(measured.sigma[np.isfinite(measured.sigma)]),
        **taken(measured, *OF_FIT),
    )


def sensor_map(message: ZernikeCoefficients, source: str) -> Seen:
    """The surface that a sensor measured, and the residual that its terms leave, m rms.

    Raises:
        MapRejectedError: an unknown convention, too few terms, or values that are not finite or of another unit.
    """
    radius, wavelength = message.radius, message.wavelength
    convention = message.convention or BORN_WOLF
    if convention not in CONVENTIONS:
        raise MapRejectedError(f"{source}: convention = {convention!r}: must be one of {', '.join(CONVENTIONS)}")
    try:
        coefficients = to_born_wolf(message.coefficients, convention)
    except ValueError as error:
        raise MapRejectedError(f"{source}: {error}") from error
    for name, value in (("coefficients", coefficients), ("radius", radius), ("wavelength", wavelength)):
        for wrong in np.extract(~np.isfinite(value), value):
            raise MapRejectedError(f"{source}: {name} = {wrong:g}: must be finite")
    if (largest := float(np.abs(coefficients).max())) > HEIGHT_MAX:
        raise MapRejectedError(f"{source}: coefficients up to {largest:g} m: must be {HEIGHT_MAX:g} m or less; in m?")
    pitch = 2.0 * radius / PIXELS if radius > 0.0 else None
    surface = SurfaceMap(disc_terms() @ coefficients, wavelength, pitch, "zernike", instrument=source)
    return surface, message.residual_rms


def samples_message(measured: Measurement, header: Header) -> SurfaceSamples:
    """The sag at the sampling points."""
    points = measured.points
    return SurfaceSamples(
        header=header,
        x=doubles(points.x),
        y=doubles(points.y),
        weight=doubles(points.weight),
        sag=doubles(measured.sag),
    )
