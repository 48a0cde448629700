"""Measurements, on request, from a sensor that publishes Zernike coefficients. Independent of ROS."""

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.map_files import SurfaceMap
from dm_calibration.optics.aperture import MapRejectedError
from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal
from dm_common.measurement import Measurement
from dm_common.optics.zernike import basis

#: Width and height, in pixels, of the map that is drawn from coefficients.
PIXELS = 256
#: Relative difference between radii that counts as rounding.
SAME_RADIUS = 1e-6

#: A surface, and the residual that the sensor reports, m rms.
Seen = tuple[SurfaceMap, float]


@cache
def disc_terms() -> Floats:
    """The terms over a map, (PIXELS, PIXELS, 21), NaN outside the disc that touches the edges; row 0 = top."""
    centres = (2.0 * np.arange(PIXELS) + 1.0) / PIXELS - 1.0
    x, y = np.meshgrid(centres, -centres)
    return np.where((x**2 + y**2 <= 1.0)[..., None], basis(x, y), np.nan)


def read_sensor(seen: Seen, ingest: Ingest, settings: IngestSettings) -> tuple[SurfaceMap, Measurement]:
    """Map and measurement from the surface `seen` by a sensor, over the configured aperture, else over the sensor's.

    Raises:
        MapRejectedError, InsufficientDataError: see :class:`Ingest`; also if the aperture is larger than the sensor's.
    """
    surface, residual_rms = seen
    settings = replace(settings, pitch=0.0)  # the parameter applies to a camera only
    radius, wanted = 0.5 * PIXELS * (surface.pitch or 0.0), settings.aperture_radius
    if wanted > radius * (1.0 + SAME_RADIUS):
        raise MapRejectedError(f"radius = {radius:g} m: must be at least aperture.radius = {wanted:g} m, and not 0")
    if not wanted and radius:
        settings = replace(settings, aperture_radius=radius, aperture_centre=(0.0, 0.0))
    surface, measured = ingest.measure(surface, settings)
    sag = basis(measured.points.x, measured.points.y) @ measured.coefficients  # exact, also between pixels
    unknown = np.full_like(measured.coefficients, np.nan)
    return surface, replace(measured, residual_rms=residual_rms, sag=sag, sigma=unknown)


class SensorAcquisition:
    """Takes the first measurement begun after a request; measurements between requests are ignored.

    Args:
        read: makes the map and the measurement from the surface that the sensor saw.
    """

    #: Always "": a sensor uses no folder.
    folder_trouble = ""

    def __init__(
        self, source: str, read: Callable[[Seen], tuple[SurfaceMap, Measurement]], now_ns: Callable[[], int]
    ) -> None:
        self.source = source
        self._read, self._now_ns = read, now_ns
        self._changed = threading.Condition()
        self._stopped, self._since = True, -1  # ns; -1 = nobody waits
        self._seen: tuple[Callable[[], Seen], int] | None = None

    def start(self) -> None:
        """Take measurements from now on."""
        self._stopped = False

    def stop(self) -> None:
        """End a measurement that is under way."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def offer(self, seen: Callable[[], Seen], stamp_ns: int) -> None:
        """Offer the surface `seen` by the sensor at `stamp_ns`; it is evaluated only if a request waits for it."""
        with self._changed:
            if 0 <= self._since <= stamp_ns and self._seen is None:
                self._seen = seen, stamp_ns
                self._changed.notify_all()

    def acquire(self, timeout_s: float) -> tuple[SurfaceMap, Measurement]:
        """The next measurement, with its time stamp.

        Raises:
            MapRejectedError and whatever else `read` raises: the measurement is unusable.
            Refusal: MAP_TIMEOUT when none came in time, INTERFEROMETER_INACTIVE when :meth:`stop` was called meanwhile.
        """
        with self._changed:
            self._seen, self._since = None, self._now_ns()
            self._changed.wait_for(lambda: self._seen is not None or self._stopped, timeout_s)
            found, self._since = self._seen, -1
        if self._stopped:
            raise Refusal(
                ErrorCode.INTERFEROMETER_INACTIVE, "the interferometer was deactivated during the measurement"
            )
        if found is None:
            raise Refusal(
                ErrorCode.MAP_TIMEOUT,
                f"nothing with a later stamp than the request came on {self.source} within {timeout_s:g} s; is the "
                "sensor running, and does its clock agree with this one?",
            )
        surface, measured = self._read(found[0]())
        return surface, replace(measured, stamp_ns=found[1])
