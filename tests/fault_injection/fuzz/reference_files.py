"""The intact files that the fuzzer damages, and where in them each value stands.

Places are told by the formats' descriptions and found from outside, so that nothing here leans on the readers it tests.
"""

from __future__ import annotations

import io
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.geometry import neighbour_pairs
from dm_common.limits import Limits
from dm_common.measurement import Measurement, Setup
from dm_common.mirror import Mirror
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import basis
from dm_simulation.interferometer.zygo_files import encode_dat, encode_datx

SAMPLES = Path(__file__).parent
WAVELENGTH = 632.8e-9
PITCH = 24e-6
TIME = 1571391436
#: Unit of the heights in the `.xyz` file.
XYZ_UNIT = "nm"
CALIBRATION_ID = "fuzz"

#: Byte ranges (start, end) by the name of what stands there.
Places = Mapping[str, tuple[tuple[int, int], ...]]

#: `.dat`: offset and struct code of the header fields that a mutation sets to extremes.
DAT_FIELDS = {
    "magic": (0, ">I"),
    "format": (4, ">H"),
    "header_size": (6, ">I"),
    "intensity_width": (52, ">H"),
    "intensity_height": (54, ">H"),
    "intensity_buckets": (56, ">H"),
    "intensity_bytes": (60, ">I"),
    "origin_x": (64, ">h"),
    "origin_y": (66, ">h"),
    "width": (68, ">H"),
    "height": (70, ">H"),
    "phase_bytes": (72, ">I"),
    "time_stamp": (76, ">I"),
    "scale": (164, ">f"),
    "wavelength": (168, ">f"),
    "obliquity": (176, ">f"),
    "pitch": (184, ">f"),
    "resolution": (218, ">h"),
    "sign": (232, ">h"),
    "camera_width": (234, ">h"),
    "camera_height": (236, ">h"),
    "serial": (242, ">h"),
}
#: Text formats: line and position of the header fields, both from 1.
TEXT_FIELDS = {
    "scale": (8, 2),
    "wavelength": (8, 3),
    "obliquity": (8, 5),
    "pitch": (8, 7),
    "resolution": (11, 1),
    "sign": (11, 8),
}
DAT_HEADER = 834


@dataclass(frozen=True)
class ReferenceFile:
    """A whole file of one format.

    Attributes:
        format: key of FORMATS.
        suffix: of the file name.
        content: the bytes.
        places: byte ranges of named values; "samples" is the phase data of a binary format.
        sample_bytes: bytes per sample of a binary format.
    """

    format: str
    suffix: str
    content: bytes
    places: Places = field(default_factory=dict)
    sample_bytes: int = 0


def surface(width: int = 24, height: int = 20) -> NDArray[np.float64]:
    """(height, width) sag in m of a tilted bowl, NaN in the corners, no two pixels alike."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = (x - (width - 1) / 2) / (width / 2), (y - (height - 1) / 2) / (height / 2)
    sag = 300e-9 * (x**2 + y**2) + 40e-9 * x + 25e-9 * y + 3e-9 * x * y
    sag[x**2 + y**2 > 1.2] = np.nan
    return sag


def _dat() -> ReferenceFile:
    content = encode_dat(surface(), PITCH, WAVELENGTH, TIME, intensity=True, phase_resolution=1)
    places = {name: ((at, at + struct.calcsize(code)),) for name, (at, code) in DAT_FIELDS.items()}
    places["samples"] = ((len(content) - 4 * surface().size, len(content)),)
    return ReferenceFile("dat", ".dat", content, places, 4)


def _datx() -> ReferenceFile:
    content = encode_datx(surface(), PITCH, WAVELENGTH, TIME, unit="Fringes")
    with h5py.File(io.BytesIO(content), "r") as file:
        (data,) = file["Data/Surface"].values()
        start, size = data.id.get_offset(), data.id.get_storage_size()
    places: dict[str, tuple[tuple[int, int], ...]] = {"samples": ((start, start + size),)}
    for name, value in (("wavelength", WAVELENGTH), ("pitch", PITCH), ("scale", 0.5), ("obliquity", 1.0)):
        places[name] = _occurrences(content, struct.pack("<d", value), (start, start + size))
    places["unit"] = _occurrences(content, b"Fringes", (start, start + size))
    return ReferenceFile("datx", ".datx", content, places, 8)


def _occurrences(content: bytes, pattern: bytes, outside: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    found, at = [], content.find(pattern)
    while at >= 0:
        if not outside[0] <= at < outside[1]:
            found.append((at, at + len(pattern)))
        at = content.find(pattern, at + 1)
    return tuple(found)


def _text_header(title: str, width: int, height: int) -> str:
    return "\n".join(
        [
            title,
            '0 6 4 0 "Thu Jan  1 01:00:00 1970     "',
            "0 0 0 0 0 0",
            f"12 34 {width} {height}",
            '"comment"',
            '""',
            '"PDM30-37"',
            f"0 0.5 {WAVELENGTH:g} 0.5 1 0 {PITCH:g} {TIME}",
            '640 480 4 0 651012 0 ""',
            "0 0 1 34 0 1 0 43.6713 0 0",
            "1 10 100 0 0 0 0 0 0",
            '0 ""',
            "1.5 0.01",
            '""',
            "#",
            "",
        ]
    )


def _asc() -> ReferenceFile:
    sag = surface()
    counts = np.where(np.isfinite(sag), np.rint(np.nan_to_num(sag) / (0.5 * WAVELENGTH / 32768)), 2147483640)
    words = [str(int(count)) for count in counts.ravel()]
    lines = [" ".join(words[start : start + 10]) for start in range(0, len(words), 10)]
    text = _text_header("Zygo ASCII Data File - Format 2", sag.shape[1], sag.shape[0])
    return ReferenceFile("asc", ".asc", (text + "#\n" + "\n".join(lines) + "\n#\n").encode())


def _xyz() -> ReferenceFile:
    sag = surface()
    lines = [
        f"{12 + column} {34 + row} " + (f"{sag[row, column] * 1e9:.6f}" if np.isfinite(sag[row, column]) else "No Data")
        for row in range(sag.shape[0])
        for column in range(sag.shape[1])
    ]
    text = _text_header("Zygo XYZ Data File - Format 1", sag.shape[1], sag.shape[0])
    return ReferenceFile("xyz", ".xyz", (text + "\n".join(lines) + "\n#\n").encode())


def _calibration() -> ReferenceFile:
    """A calibration of a seven-actuator mirror with Gaussian bumps."""
    angles = np.radians(60.0 * np.arange(6))
    x, y = 4.3e-3 * np.append(0.0, np.cos(angles)), 4.3e-3 * np.append(0.0, np.sin(angles))
    mirror = Mirror("PDM30-37", "fuzz", x, y, 11e-3, Limits(pairs=neighbour_pairs(x, y)))
    points = edge_clustered_points(60)
    away = np.hypot(points.x[:, None] * 11e-3 - x, points.y[:, None] * 11e-3 - y)
    influence = 4e-6 * np.exp(-((away / 4e-3) ** 2))
    modes = basis(points.x, points.y)
    outcome = Outcome(setup=Setup(points, WAVELENGTH, -1))
    for number, step in enumerate(make_plan(PlanKind.POKES, mirror, PlanOptions(degauss=False)).steps):
        assert step.signals is not None
        sag = influence @ step.signals
        terms = np.asarray(np.linalg.lstsq(modes, sag, rcond=None)[0], dtype=np.float64)
        record = Measurement(
            points=points,
            sag=sag,
            coefficients=terms,
            sigma=np.full(21, 1e-10),
            stamp_ns=number * 10**9,
            residual_rms=1e-9,
            valid_fraction=0.99,
            file=f"/maps/{number}.dat",
            sha256="ab" * 32,
            label=step.label,
            kind=step.kind.value,
            step=number,
            signals=step.signals,
            applied=step.signals,
        )
        outcome.records.append(record)
    calibration = calibrate(outcome, mirror=mirror, options=FitOptions(), provenance=Provenance(CALIBRATION_ID, 10**18))
    with tempfile.TemporaryDirectory() as folder:
        content = CalibrationStore(Path(folder)).save(calibration).read_bytes()
    return ReferenceFile("calibration", ".h5", content)


def _fits() -> ReferenceFile:
    """`fits_bytes` of dm_calibration's test/map_fixtures.py made it of 1e9 * surface(), with a checksum."""
    content = (SAMPLES / "sample.fits").read_bytes()
    start = len(content) - 2 * 2880
    return ReferenceFile("fits", ".fits", content, {"samples": ((start, start + 8 * surface().size),)}, 8)


def _h5() -> ReferenceFile:
    """`h5_bytes` made it, there too, of surface() / WAVELENGTH."""
    content = (SAMPLES / "sample.h5").read_bytes()
    with h5py.File(io.BytesIO(content), "r") as file:
        data = file["measurement0/genraw/data"]
        samples = data.id.get_offset(), data.id.get_offset() + data.id.get_storage_size()
    texts = {"wavelength": b"632.8 nm", "pitch": b"0.024 mm"}
    places = {"samples": (samples,)} | {name: _occurrences(content, text, samples) for name, text in texts.items()}
    places["pitch"] += _occurrences(content, b"xpix", samples)  # without its name it is not told
    return ReferenceFile("h5", ".h5", content, places, 4)


def _four_d() -> ReferenceFile:
    """`four_d_bytes` made it, there too, of surface() / WAVELENGTH."""
    content = (SAMPLES / "sample.4D").read_bytes()
    with h5py.File(io.BytesIO(content), "r") as file:
        data = file["Measurement/SurfaceInWaves/Data"]
        samples = data.id.get_offset(), data.id.get_offset() + data.id.get_storage_size()
    places = {"samples": (samples,), "wavelength": _occurrences(content, struct.pack("<d", 632.8), samples)}
    return ReferenceFile("4D", ".4D", content, places, 4)


FORMATS = {
    "dat": _dat,
    "datx": _datx,
    "asc": _asc,
    "xyz": _xyz,
    "fits": _fits,
    "h5": _h5,
    "4D": _four_d,
    "calibration": _calibration,
}


def reference_file(name: str) -> ReferenceFile:
    """The intact file of the format `name`.

    Raises:
        ValueError: no such format.
    """
    if name not in FORMATS:
        raise ValueError(f"format = {name!r}: must be one of {', '.join(FORMATS)}")
    return FORMATS[name]()
