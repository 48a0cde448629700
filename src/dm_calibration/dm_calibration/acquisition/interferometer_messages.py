"""Measurements as ROS messages."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from dm_msgs.msg import SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from dm_calibration.acquisition.ingest import Measurement


def image_message(measurement: Measurement, header: Header) -> Image:
    """The map as 32FC1, metres, NaN = no data."""
    height, width = measurement.sag.shape
    message = Image(header=header, height=height, width=width, encoding="32FC1", is_bigendian=0, step=4 * width)
    # An array.array is taken over as it is; anything else is checked byte by byte.
    message.data = array.array("B")
    message.data.frombytes(measurement.sag.astype("<f4").data.cast("B"))
    return message


def info_message(measurement: Measurement, header: Header) -> SurfaceMapInfo:
    height, width = measurement.sag.shape
    aperture, source = measurement.aperture, measurement.source
    subtracted = source.system_error_subtracted
    return SurfaceMapInfo(
        header=header,
        width=width,
        height=height,
        pitch=measurement.pitch or 0.0,
        wavelength=source.wavelength,
        centre_x=aperture.centre_x_px,
        centre_y=aperture.centre_y_px,
        aperture_radius_px=aperture.radius_px,
        aperture_radius=measurement.aperture_radius or 0.0,
        valid_fraction=measurement.fit.valid_fraction,
        pv=measurement.pv,
        rms=measurement.rms,
        piston_tilt_removed=measurement.piston_tilt_removed,
        system_error_subtracted=-1 if subtracted is None else int(subtracted),
        instrument=f"{source.instrument}, serial {source.serial}" if source.serial else source.instrument,
        file=source.file,
        sha256=source.sha256,
    )


def zernike_message(measurement: Measurement, header: Header) -> ZernikeCoefficients:
    fit = measurement.fit
    centre_x, centre_y = measurement.aperture_centre
    return ZernikeCoefficients(
        header=header,
        convention=ZernikeCoefficients.BORN_WOLF,
        radius=measurement.aperture_radius or 0.0,
        centre_x=centre_x,
        centre_y=centre_y,
        wavelength=measurement.source.wavelength,
        coefficients=_doubles(fit.coefficients),
        sigma=_doubles(fit.sigma),
        residual_rms=fit.residual_rms,
        valid_fraction=fit.valid_fraction,
    )


def samples_message(measurement: Measurement, header: Header) -> SurfaceSamples:
    points = measurement.points
    return SurfaceSamples(
        header=header,
        radius=measurement.aperture_radius or 0.0,
        x=_doubles(points.x),
        y=_doubles(points.y),
        weight=_doubles(points.weight),
        sag=_doubles(measurement.samples),
    )


def _doubles(values: NDArray[np.float64]) -> Any:
    return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())
