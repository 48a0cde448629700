"""Writers of ZYGO map files, as the instrument's own software leaves them in its folder.

`.dat`: the MetroPro binary format (MetroPro Reference Guide, OMP-0347, section 12: header format 1, 834 bytes,
big-endian). `.datx`: HDF5 as Mx writes it.
"""

import contextlib
import io
import os
import re
import struct
import time
from pathlib import Path

import h5py
import numpy as np

from dm_simulation.mirror.zernike import Array

MAGIC, HEADER_FORMAT, HEADER_SIZE = 0x881B036F, 1, 834
INVALID_COUNT = 2147483640
#: Interferometric scale factor of a double pass: one fringe is half a wavelength of surface.
SCALE_FACTOR = 0.5
#: Counts per fringe of phase resolution codes 0, 1, 2.
RESOLUTION = (4096, 32768, 131072)
#: Value that Mx stores where there is no data.
NO_DATA = 1.7976931348623157e308
FORMATS = ("dat", "datx")
MAP_NAME = re.compile(rf"(map_\d{{6,}}|measure_\d+_\d+)\.({'|'.join(FORMATS)})")
UNITS = ("Fringes", "NanoMeters")
#: Number of pieces in which a file grows on a slow network share.
PIECES = 8


def encode_dat(
    sag: Array,
    pitch: float,
    wavelength: float,
    unix_time: int,
    *,
    intensity: bool = False,
    phase_resolution: int = 2,
    part_name: str = "PDM30-37",
) -> bytes:
    """A whole `.dat` file.

    Args:
        sag: (h, w), m, row 0 = top, NaN = no data.
        pitch: m per pixel, 0 = unknown.
        intensity: write an intensity frame (bright where the phase is valid) before the phase.
        phase_resolution: code 0, 1 or 2; one count is scale * wavelength / (4096, 32768, 131072).

    Raises:
        ValueError: a height that does not fit the counts.
    """
    height, width = sag.shape
    valid = np.isfinite(sag)
    counts = np.full(sag.shape, INVALID_COUNT, ">i4")
    scaled = np.rint(sag[valid] / (SCALE_FACTOR * wavelength / RESOLUTION[phase_resolution]))
    if scaled.size and np.abs(scaled).max() >= INVALID_COUNT:
        raise ValueError(f"sag: {np.abs(sag[valid]).max():g} m does not fit phase resolution {phase_resolution}")
    counts[valid] = scaled
    frame = np.where(valid, 180, 12).astype(">u2") if intensity else np.empty(0, ">u2")

    header = bytearray(HEADER_SIZE)

    def put(offset: int, layout: str, *values: object) -> None:
        struct.pack_into(layout, header, offset, *values)

    put(0, ">IHI", MAGIC, HEADER_FORMAT, HEADER_SIZE)
    put(10, ">h", 1)
    if intensity:
        put(52, ">HHH", width, height, 1)
        put(60, ">I", frame.nbytes)
    put(68, ">HHI", width, height, counts.nbytes)
    put(76, ">I", unix_time & 0xFFFFFFFF)
    put(80, "82s", b"virtual bench")
    put(164, ">ff", SCALE_FACTOR, wavelength)
    put(176, ">f", 1.0)
    put(184, ">f", pitch)
    put(218, ">h", phase_resolution)
    put(234, ">hh", width, height)
    put(258, "40s", part_name.encode("ascii", "replace"))
    return bytes(header) + frame.tobytes() + counts.tobytes()


def encode_datx(
    sag: Array,
    pitch: float,
    wavelength: float,
    unix_time: int,
    *,
    unit: str = "NanoMeters",
    part_name: str = "PDM30-37",
) -> bytes:
    """A whole `.datx` file: sag (h, w) in m, row 0 = top, NaN = no data; `unit` one of UNITS."""
    per_metre = 1e9 if unit == "NanoMeters" else 1 / (SCALE_FACTOR * wavelength)
    values = np.where(np.isfinite(sag), sag * per_metre, NO_DATA)
    measurement, surface, attributes = "{6F1A-M}", "{6F1A-S}", "{6F1A-A}"
    text = h5py.string_dtype()
    converter = np.dtype([("Category", text), ("BaseUnit", text), ("Parameters", h5py.vlen_dtype(np.float64))])

    def convert(category: str, base: str, parameters: list[float]) -> np.ndarray:
        row = np.empty(1, converter)
        row[0] = (category, base, np.array(parameters))
        return row

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        data = file.create_dataset(f"Data/Surface/{surface}", data=values)
        data.attrs.create("Unit", [unit], dtype=text)
        data.attrs["No Data"] = np.array([NO_DATA])
        data.attrs["Wavelength"] = np.array([wavelength])
        data.attrs["Interferometric Scale Factor"] = np.array([SCALE_FACTOR])
        data.attrs["Obliquity Factor"] = np.array([1.0])
        for name in ("X Converter", "Y Converter"):
            data.attrs.create(name, convert("LateralCat", "Pixels", [0.0, pitch, 0.0, 0.0]), dtype=converter)
        height = [0.0, wavelength, SCALE_FACTOR, 1.0]
        data.attrs.create("Z Converter", convert("HeightCat", unit, height), dtype=converter)
        group = file.create_group(f"Attributes/{attributes}")
        group.attrs["Data Context.Lateral Resolution:Value"] = np.array([pitch])
        group.attrs["Data Context.Data Attributes.Subtract System Error"] = np.array([0], np.uint8)
        group.attrs["Subtract System Error"] = np.array([0], np.uint8)
        group.attrs.create("Data Context.Part Name", [part_name], dtype=text)
        group.attrs["Data Context.Time Stamp"] = np.array([float(unix_time)])
        links = [
            ("Root", "Measurement", measurement),
            (measurement, "Attributes", attributes),
            (attributes, "Path", f"/Attributes/{attributes}"),
            (measurement, "Surface", surface),
            (surface, "Path", f"/Data/Surface/{surface}"),
        ]
        row = np.dtype([("Source", text), ("Link", text), ("Destination", text)])
        file.create_dataset("MetaData", data=np.array(links, row))
    return buffer.getvalue()


def deliver(content: bytes, path: Path, seconds: float = 0.0) -> None:
    """Put a file in its place.

    With `seconds` = 0 it appears whole: written under a temporary name in the same folder, then renamed. Otherwise it
    grows under its own name in PIECES over that many seconds of wall time, as on a slow network share.

    Raises:
        OSError: the folder is missing or full; no part of a file is left behind.
    """
    if seconds > 0:
        step = -(-len(content) // PIECES)
        try:
            with path.open("wb") as file:
                for start in range(0, len(content), step):
                    if start:
                        time.sleep(seconds / (PIECES - 1))
                    file.write(content[start : start + step])
                    file.flush()
        except OSError:
            path.unlink(missing_ok=True)
            raise
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def prune(folder: Path, limit: float, keep: Path | None = None) -> None:
    """Remove the oldest maps until those in `folder` take no more than `limit` bytes, but not the newest, nor `keep`.

    Only files with a name that the bench or the node `interferometer` gives to maps are counted and removed.
    """
    maps = []
    for path in (path for path in folder.iterdir() if MAP_NAME.fullmatch(path.name)):
        with contextlib.suppress(OSError):  # somebody else removed it
            maps.append((path.stat().st_mtime_ns, path.stat().st_size, path))
    total = 0
    for number, (_time, size, path) in enumerate(sorted(maps, reverse=True)):
        total += size
        if number and total > limit and path != keep:
            with contextlib.suppress(OSError):
                path.unlink()
