"""What a calibration measures, what it drives, and how either can fail. Knows no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.sampling import SamplePoints

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
        instrument: what took the map, with its serial number; "" = not told.
        pitch: m per pixel; 0 = unknown.
        camera: width and height of the map, pixels; zeros = not told.
        centre: of the aperture from the left and top edge of the map, pixels; NaN = not told.
        radius_px: of the aperture, pixels; 0 = not told.
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
    instrument: str = ""
    pitch: float = 0.0
    camera: tuple[int, int] = (0, 0)
    centre: tuple[float, float] = (float("nan"), float("nan"))
    radius_px: float = 0.0


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
