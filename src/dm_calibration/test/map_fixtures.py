"""Map files made by hand from the format descriptions, byte by byte, for tests of the readers."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

ORACLE_MISSING = "no SurfaceTopography; run it with: ./dm exec python -m pip install -r requirements/test-oracles.txt"
NO_DATA = 2147483640
WAVELENGTH = 632.8e-9

DAT_DEFAULTS: dict[str, tuple[int, str, Any]] = {
    "magic": (0, ">I", 0x881B036F),
    "format": (4, ">H", 1),
    "header_size": (6, ">I", 834),
    "software": (10, ">h", 1),
    "origin_x": (64, ">h", 12),
    "origin_y": (66, ">h", 34),
    "time": (76, ">I", 1429905292),
    "S": (164, ">f", 0.5),
    "W": (168, ">f", WAVELENGTH),
    "O": (176, ">f", 1.0),
    "pitch": (184, ">f", 24e-6),
    "resolution": (218, ">h", 1),
    "sign": (232, ">h", 0),
    "system": (238, ">h", 4),
    "serial": (242, ">H", 62398),
    "part": (258, "40s", b"PDM30-37 no. 7"),
    "subtracted": (302, ">h", 0),
}


def dat_bytes(counts: NDArray[Any], intensity: NDArray[Any] | None = None, **fields: Any) -> bytes:
    """A `.dat` file of these phase counts (h, w) and intensity frames (buckets, h, w)."""
    size = fields.get("header_size", 834)
    header = bytearray(max(size, 834))
    for name, (offset, code, default) in DAT_DEFAULTS.items():
        struct.pack_into(code, header, offset, fields.get(name, default))
    height, width = counts.shape
    struct.pack_into(">HHI", header, 68, width, height, 4 * width * height)
    body = b""
    if intensity is not None:
        buckets, rows, columns = intensity.shape
        struct.pack_into(">HHH", header, 52, columns, rows, buckets)
        struct.pack_into(">I", header, 60, 2 * intensity.size)
        body = b"".join(struct.pack(">H", int(value)) for value in intensity.ravel())
    return bytes(header) + body + counts.astype(">i4").tobytes()


def text_header(width: int, height: int, title: str = "Zygo ASCII Data File - Format 2", **fields: Any) -> str:
    """The fourteen header lines and the `#`."""
    get = fields.get
    return "\n".join(
        [
            title,
            '0 6 4 0 "Thu Jan  1 01:00:00 1970     "',
            get("intensity_line", "0 0 0 0 0 0"),
            f"{get('origin_x', 12)} {get('origin_y', 34)} {width} {height}",
            get("comment", '""   "'),
            '"" "',
            f'"{get("part", "mirror")}"',
            f"0 {get('S', 0.5)} {get('W', WAVELENGTH)} 0.5 {get('O', 1)} 0 {get('pitch', 24e-6)} 1571391436",
            '640 480 4 0 651012 0 "" "',
            "0 0 1 34 0 1 0 43.6713 0 0",
            f"{get('resolution', 1)} 10 100 0 0 0 0 {get('sign', 0)} 0",
            f'{get("subtracted", 0)} ""  "',
            "1.5 0.01",
            '""  "',
            "#",
            "",
        ]
    )


def asc_bytes(counts: NDArray[Any], intensity: Sequence[int] | None = (), **fields: Any) -> bytes:
    """An `.asc` file; intensity None leaves that section out."""
    height, width = counts.shape
    words = [str(value) for value in counts.ravel()]
    lines = [" ".join(words[start : start + 10]) + " " for start in range(0, len(words), 10)]
    section = "" if intensity is None else " ".join(map(str, intensity)) + "\n#\n"
    return (text_header(width, height, **fields) + section + "\n".join(lines) + "\n#\n").encode("latin-1")


def xyz_bytes(values: NDArray[Any], title: str = "Zygo XYZ Data File - Format 1", **fields: Any) -> bytes:
    """An `.xyz` file of values in whatever unit, NaN = No Data, column and row on the camera."""
    height, width = values.shape
    left, top = fields.get("origin_x", 12), fields.get("origin_y", 34)
    lines = [
        f"{left + column} {top + row} {float(values[row, column])!r}".replace("nan", "No Data")
        for row in range(height)
        for column in range(width)
    ]
    return (text_header(width, height, title, **fields) + "\n".join(lines) + "\n#\n").encode()


SURFACE_ID, ATTRIBUTES_ID = "{5D0C}", "{A77B}"
SURFACE_PATH, ATTRIBUTES_PATH = f"/Data/Surface/{SURFACE_ID}", f"/Attributes/{ATTRIBUTES_ID}"


def datx_bytes(values: NDArray[Any], unit: str) -> bytes:
    """A `.datx` file of `values` (height, width), NaN = no data."""
    buffer = io.BytesIO()
    write_datx(buffer, np.where(np.isfinite(values), values, 1.7976931348623157e308), unit)
    return buffer.getvalue()


def write_datx(
    path: Path | io.BytesIO,
    values: NDArray[Any],
    unit: str = "Fringes",
    *,
    attributes: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
    pitch: float = 24e-6,
    **dataset: Any,
) -> None:
    """A `.datx` file; an attribute given as None is left out."""
    converter = np.dtype([("Category", h5py.string_dtype()), ("BaseUnit", h5py.string_dtype()), ("P", "f8", (4,))])
    found: dict[str, Any] = {
        "Unit": np.array([unit.encode()], dtype=object),
        "No Data": np.array([1.7976931348623157e308]),
        "Wavelength": np.array([WAVELENGTH]),
        "Interferometric Scale Factor": np.array([0.5]),
        "Obliquity Factor": np.array([1.0]),
        "X Converter": np.array([(b"LateralCat", b"Pixels", [0, pitch, 0, 0])], dtype=converter),
        "Y Converter": np.array([(b"LateralCat", b"Pixels", [0, pitch, 0, 0])], dtype=converter),
    }
    found.update(attributes or {})
    links = [
        ("Root", "Measurement", "{M}"),
        ("{M}", "Surface", "{S}"),
        ("{S}", "Path", SURFACE_PATH),
        ("{M}", "Attributes", "{A}"),
        ("{A}", "Path", ATTRIBUTES_PATH),
    ]
    table = np.dtype([(name, h5py.string_dtype("ascii")) for name in ("Source", "Link", "Destination")])
    with h5py.File(path, "w") as file:
        file.create_dataset("MetaData", data=np.array(links, dtype=table))
        surface = file.create_dataset(SURFACE_PATH, data=values, **dataset)
        for name, value in found.items():
            if value is not None:
                if value.dtype == object:
                    surface.attrs.create(name, value, dtype=h5py.string_dtype())
                else:
                    surface.attrs[name] = value
        group = file.create_group(ATTRIBUTES_PATH)
        for name, value in (extra or {}).items():
            group.attrs[name] = value


def disc_counts(size: int, amplitude: int = 1000, seed: int = 0) -> NDArray[np.int64]:
    """Counts of a bowl on a disc that fills a square map, with the corners marked as no data."""
    y, x = (np.mgrid[:size, :size] - (size - 1) / 2) / (size / 2)
    noise = np.random.default_rng(seed).integers(-3, 4, (size, size))
    counts = np.rint(amplitude * (x**2 + y**2) + 0.1 * amplitude * x).astype(np.int64) + noise
    return np.where(x**2 + y**2 <= 1, counts, NO_DATA)


def fits_bytes(values: NDArray[Any], checksum: bool = True, **cards: Any) -> bytes:
    """A FITS file of `values` (height, width), row 0 = top; a card given as None is left out."""
    kinds = {"u1": 8, "i2": 16, "i4": 32, "f4": -32, "f8": -64}
    height, width = values.shape
    found: dict[str, Any] = {
        "SIMPLE": True,
        "BITPIX": kinds[f"{values.dtype.kind}{values.dtype.itemsize}"],
        "NAXIS": 2,
        "NAXIS1": width,
        "NAXIS2": height,
        "BUNIT": "nm",
        "WAVELEN": WAVELENGTH,
        "PUPLSCAL": 24e-6,
        **cards,
    }
    if checksum:
        found["CHECKSUM"] = "0" * 16
    lines = []
    for name, value in found.items():
        if value is not None:
            plain = "T" if value is True else repr(value)
            text = f"'{value:8}'".ljust(20) if isinstance(value, str) else plain.rjust(20)
            lines.append(f"{name:8}= {text} / as the standard has it".ljust(80)[:80])
    header = "".join([*lines, "END".ljust(80)]).encode()
    data = values[::-1].astype(values.dtype.newbyteorder(">")).tobytes()
    content = header.ljust(-(-len(header) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")
    return content.replace(b"0" * 16, _checksum(content), 1) if checksum else content


def _checksum(content: bytes) -> bytes:
    """The sixteen characters that make the ones' complement sum of `content`, which has zeros for them, all ones."""
    total = sum(int.from_bytes(content[at : at + 4], "big") for at in range(0, len(content), 4))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    columns = []
    for byte in (total ^ 0xFFFFFFFF).to_bytes(4, "big"):
        parts = [byte // 4 + 48 + (byte % 4 if k == 0 else 0) for k in range(4)]
        while any(58 <= part <= 64 or 91 <= part <= 96 for part in parts):
            for k in (0, 2):  # no punctuation: up with one, down with its neighbour
                if any(58 <= part <= 64 or 91 <= part <= 96 for part in parts[k : k + 2]):
                    parts[k], parts[k + 1] = parts[k] + 1, parts[k + 1] - 1
        columns.append(parts)
    text = bytes(columns[byte][k] for k in range(4) for byte in range(4))
    return text[-1:] + text[:-1]


def h5_bytes(
    waves: NDArray[Any],
    wavelength: str = "632.8 nm",
    xpix: str | None = "0.024 mm",
    path: str = "measurement0/genraw",
) -> bytes:
    """A file of 4Sight of `waves` (height, width), NaN = no data."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        group = file.create_group(path)
        group["data"] = np.where(np.isfinite(waves), waves, np.finfo(np.float32).max).astype("<f4")
        group.attrs["wavelength"] = np.bytes_(wavelength)
        if xpix is not None:
            group.attrs["xpix"] = np.bytes_(xpix)
    return buffer.getvalue()


def four_d_bytes(waves: NDArray[Any], **attributes: Any) -> bytes:
    """A file of a newer 4Sight of `waves` (height, width), NaN = no data."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["Measurement/SurfaceInWaves/Data"] = waves.astype("<f4")
        file["Measurement"].attrs.update(attributes or {"WavelengthInNanometers": 632.8})
    return buffer.getvalue()
