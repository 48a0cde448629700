"""A measured surface map, as every reader of this package returns it, and checks that the readers share."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools, Floats
from dm_common.errors import CodedError, ErrorCode

#: Counts of this value and above mean "no data" (MetroPro reference, phase data matrix).
INVALID_COUNTS = 2147483640

#: Counts per fringe by phase resolution code.
COUNTS_PER_FRINGE = {0: 4096, 1: 32768, 2: 131072}

#: Largest map that is read; the largest cameras of these instruments have 12 million pixels.
MAX_PIXELS = 2**25

#: Units of length used in files, as m.
METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "angstrom": 1e-10}

#: Largest height of a map, or coefficient of a sensor, m: no instrument measures more, so it would be another unit.
HEIGHT_MAX = 1e-3

#: Largest relative difference between the pitches along x and y for which pixels count as square.
SQUARE_TOLERANCE = 0.01

#: Relative tolerance for wavelength and pitch of maps of one instrument; files keep the pitch in single precision.
SAME_LENGTH = 1e-4

_WAVELENGTH_RANGE = (1e-7, 2e-5)  # m, from deep ultraviolet to CO2 lasers
PITCH_MIN, PITCH_MAX = 1e-9, 1e-2  # m per pixel


class MapFileError(CodedError):
    """The file is not a whole, readable surface map; the message names the field, its value and what is allowed."""

    error_code = ErrorCode.MAP_UNREADABLE


class NoValidPixelsError(MapFileError):
    """The file is whole, but every pixel of its map is marked as having no data."""

    error_code = ErrorCode.MAP_INSUFFICIENT


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Surface sag on the pixel grid of an interferometer.

    Attributes:
        sag: (height, width) float64, m of surface sag (not wavefront); row 0 = top, NaN = no data.
        wavelength: m.
        pitch: m per pixel; None if the file does not contain it.
        origin: column and row of the map's top left pixel on the camera.
        format: "dat", "asc", "xyz", "datx", "fits", "h5" or "4D"; "array" or "zernike" if not from a file.
        instrument: software and system type, as given in the file.
        serial: serial number of the instrument; "" when not known.
        time_stamp: Unix time of the measurement, s; None when not known.
        system_error_subtracted: None when not known. Maps that differ in it must not be mixed.
        piston_tilt_removed: whether the plane of the map was subtracted.
        phase_steps: number of regions that were off by whole fringes and were corrected.
        file: its path, as valid UTF-8; "" = none.
        written_ns: modification time of the file, Unix time, ns; 0 = not known.
        content: the file's bytes, for :attr:`sha256`.
    """

    sag: Floats
    wavelength: float
    pitch: float | None
    format: str
    origin: tuple[int, int] = (0, 0)
    instrument: str = ""
    serial: str = ""
    time_stamp: float | None = None
    system_error_subtracted: bool | None = None
    piston_tilt_removed: bool = False
    phase_steps: int = 0
    file: str = ""
    written_ns: int = 0
    content: bytes = field(default=b"", repr=False)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the file's bytes, hexadecimal; "" without a file. Computed on first use.

        It takes as long as reading the file, and only the provenance of a calibration needs it.
        """
        return hashlib.sha256(self.content).hexdigest() if self.content else ""

    @cached_property
    def valid(self) -> Bools:
        """(height, width), True where there is data."""
        return np.isfinite(self.sag)

    @cached_property
    def pv(self) -> float:
        """Peak to valley of `sag` over all its valid pixels, m; computed on first use, as `rms`."""
        return float(np.ptp(self.sag[self.valid]))

    @cached_property
    def rms(self) -> float:
        """Standard deviation of `sag` over all its valid pixels, m."""
        return float(np.std(self.sag[self.valid]))

    def difference(
        self, reference: SurfaceMap, pitch: float, wavelength_tolerance: float, name: str = "reference_surface"
    ) -> str:
        """Why `reference`, called `name` in the sentence, cannot be subtracted from this map; "" = it can.

        Either they differ in size, place on the camera, pitch or wavelength, or the instrument has already subtracted
        its error from the map. `pitch`: m per pixel, for files that do not contain it; 0 = not known.
        """
        size = "{1} x {0} pixels from column {2}, row {3} of the camera"
        here, there = ((*each.sag.shape, *each.origin) for each in (self, reference))
        pitches = [each.pitch or pitch for each in (self, reference)]
        if here != there:
            return f"{size.format(*here)}, {name} has {size.format(*there)}"
        if all(pitches) and abs(pitches[0] - pitches[1]) > SAME_LENGTH * pitches[1]:
            return f"pitch {pitches[0] * 1e6:.3f} um, {name} has {pitches[1] * 1e6:.3f} um"
        if reference.wavelength and abs(self.wavelength - reference.wavelength) > wavelength_tolerance:
            return f"wavelength {self.wavelength * 1e9:.3f} nm, {name} has {reference.wavelength * 1e9:.3f} nm"
        if self.system_error_subtracted:
            return (
                "the instrument has subtracted its own error already: leave reference_surface empty, or switch its "
                "subtraction off"
            )
        return ""


def _outside(name: str, value: object, allowed: str) -> MapFileError:
    return MapFileError(f"{name} = {value}: must be {allowed}")


def check_wavelength(wavelength: float) -> float:
    """Return the wavelength [m] or raise MapFileError."""
    low, high = _WAVELENGTH_RANGE
    if not low <= wavelength <= high:
        raise _outside("wavelength", f"{wavelength:g} m", f"{low:g} to {high:g} m")
    return wavelength


def check_factor(name: str, value: float) -> float:
    """Return an interferometric scale or obliquity factor, or raise MapFileError; both are of the order of 1."""
    if not 0.01 <= value <= 100:
        raise _outside(name, f"{value:g}", "0.01 to 100")
    return value


def check_pitch(pitch: float) -> float | None:
    """Return the pitch [m per pixel], None for 0 (unknown), or raise MapFileError."""
    if pitch == 0:
        return None
    if not PITCH_MIN <= pitch <= PITCH_MAX:
        allowed = f"0 (unknown) or {PITCH_MIN:g} to {PITCH_MAX:g} m"
        raise _outside("lateral resolution", f"{pitch:g} m per pixel", allowed)
    return pitch


def check_size(width: int, height: int) -> int:
    """Return the number of pixels or raise MapFileError."""
    if width < 1 or height < 1:
        raise _outside("phase data", f"{width} x {height} pixels", "at least 1 x 1 (the file holds no map)")
    if width * height > MAX_PIXELS:
        raise _outside("phase data", f"{width} x {height} pixels", f"at most {MAX_PIXELS} pixels")
    return width * height


def check_heights(sag: Floats) -> None:
    """Check heights, m, NaN = no data.

    Raises:
        MapFileError: larger than any surface in front of an interferometer.
        NoValidPixelsError: there is no valid pixel.
    """
    lowest, highest = float(np.fmin.reduce(sag, axis=None)), float(np.fmax.reduce(sag, axis=None))
    if math.isnan(lowest):
        raise NoValidPixelsError(f"none of the {sag.shape[1]} x {sag.shape[0]} pixels is valid: the map holds no data")
    if max(-lowest, highest) > HEIGHT_MAX:
        raise _outside("height", f"{lowest:g} to {highest:g} m", f"-{HEIGHT_MAX:g} to {HEIGHT_MAX:g} m")


def sag_from_counts(counts: NDArray[np.integer], header: Mapping[str, Any]) -> Floats:
    """Return sag [m] of the same shape from the counts of a ZYGO file, NaN where they say "no data".

    A count is S O W / R, negative if the data are inverted. The interferometric scale factor S already turns
    double-pass fringes into surface height.

    Raises:
        MapFileError: a factor that makes heights meaningless (0, NaN, absurd) or a code of unknown meaning; or as
            :func:`check_heights`.
    """
    scale_factor = check_factor("interferometric scale factor", header["scale_factor"])
    obliquity = check_factor("obliquity factor", header["obliquity"])
    wavelength = check_wavelength(header["wavelength"])
    if header["phase_resolution"] not in COUNTS_PER_FRINGE:
        raise _outside("phase resolution code", header["phase_resolution"], "0, 1 or 2")
    if header["data_sign"] not in (0, 1):
        raise _outside("data sign", header["data_sign"], "0 (normal) or 1 (inverted)")
    sign = -1.0 if header["data_sign"] == 1 else 1.0
    metres_per_count = sign * scale_factor * obliquity * wavelength / COUNTS_PER_FRINGE[header["phase_resolution"]]
    sag = np.asarray(counts * metres_per_count, dtype=np.float64)
    sag[counts >= INVALID_COUNTS] = math.nan
    check_heights(sag)
    return sag


def zygo_map(sag: Floats, header: Mapping[str, Any], form: str, instrument: str) -> SurfaceMap:
    """`sag`, m, as a map with the header data of a ZYGO file of the format `form`. Raises MapFileError."""
    return SurfaceMap(
        sag=sag,
        wavelength=header["wavelength"],
        pitch=check_pitch(header["lateral_resolution"]),
        format=form,
        origin=(header["origin_x"], header["origin_y"]),
        instrument=instrument,
        serial=str(header["system_serial"]) if header["system_serial"] else "",
        time_stamp=float(header["time_stamp"]) if header["time_stamp"] > 0 else None,
        system_error_subtracted={0: False, 1: True}.get(header["system_error_subtracted"]),
    )
