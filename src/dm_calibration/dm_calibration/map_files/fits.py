"""Maps in FITS files: reading of the primary image, in the unit given by BUNIT (docs/map-files.md), and writing."""

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from dm_calibration.map_files.surface_map import (
    METRES,
    SQUARE_TOLERANCE,
    MapFileError,
    SurfaceMap,
    check_heights,
    check_pitch,
    check_size,
    check_wavelength,
)

CARD, BLOCK = 80, 2880
_TYPES = {8: ">u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
#: Other names of the units of `METRES` in use, in the singular.
_SPOKEN = {"meter": "m", "metre": "m", "millimeter": "mm", "micron": "um", "micrometer": "um", "nanometer": "nm"}
_KEYWORD = re.compile("[A-Z0-9_-]*")

Header = Mapping[str, Any]


def is_fits(start: bytes) -> bool:
    """Whether the first bytes of a file are the first card of a FITS file."""
    return start[:30].split() == [b"SIMPLE", b"=", b"T"]


def parse_fits(content: bytes, unit: str | None) -> SurfaceMap:
    """Parse the primary image of a whole FITS file; its heights must be surface sag.

    Args:
        unit: of the values if there is no BUNIT: m, mm, um, nm or angstrom; None = not known.

    Raises:
        MapFileError: not a complete map with a unit; the message names the keyword.
    """
    header, start = _header(content)
    width, height, kind = _layout(header)
    size = check_size(width, height) * np.dtype(kind).itemsize
    end = start + -(-size // BLOCK) * BLOCK
    if len(content) < end or len(content) % BLOCK:
        raise MapFileError(f"file length = {len(content)} bytes: must be {end}, or longer by whole blocks of {BLOCK}")
    if any(content[start + size : end]):
        raise MapFileError(f"NAXIS1 x NAXIS2 = {width} x {height}: the file holds more values")
    # With a valid CHECKSUM the 32-bit words of the file add up to zero in ones' complement.
    if "CHECKSUM" in header and int(np.frombuffer(content[:end], ">u4").sum(dtype=np.uint64)) % 0xFFFFFFFF:
        raise MapFileError("CHECKSUM does not agree with the content: the file is damaged")
    stored = np.frombuffer(content, kind, width * height, start).reshape(height, width)[::-1]  # row 1 = bottom
    own_unit = str(header.get("BUNIT", ""))
    metres = _unit(own_unit, "BUNIT") if own_unit or not unit else _unit(unit, "xyz_unit")
    sag = stored.astype(np.float64) * (_real(header, "BSCALE", 1.0) * metres) + _real(header, "BZERO", 0.0) * metres
    if stored.dtype.kind != "f" and "BLANK" in header:
        sag[stored == _real(header, "BLANK", 0.0)] = math.nan
    sag[~np.isfinite(sag)] = math.nan
    check_heights(sag)
    wavelength = _real(header, "WAVELEN", 0.0)
    return SurfaceMap(
        sag=sag,
        wavelength=check_wavelength(wavelength) if wavelength else 0.0,
        pitch=_pitch(header),
        origin=(int(_real(header, "MAPCOL", 0.0)), int(_real(header, "MAPROW", 0.0))),
        format="fits",
        instrument=str(header.get("INSTRUME", "")),
        time_stamp=_time(str(header.get("DATE-OBS", ""))),
    )


def fits_bytes(surface: SurfaceMap, instrument: str) -> bytes:
    """`surface` as a FITS file in m, which :func:`parse_fits` can read."""
    height, width = surface.sag.shape
    cards: dict[str, Any] = {"SIMPLE": "T", "BITPIX": -64, "NAXIS": 2, "NAXIS1": width, "NAXIS2": height}
    cards |= {"BUNIT": "'m       '", "WAVELEN": f"{surface.wavelength:.9E}", "PUPLSCAL": f"{surface.pitch or 0.0:.9E}"}
    cards |= {"MAPCOL": surface.origin[0], "MAPROW": surface.origin[1], "INSTRUME": f"'{instrument:8}'"}
    lines = [f"{name:8}= {value:>20}".ljust(CARD) for name, value in cards.items()]
    header = "".join([*lines, "END".ljust(CARD)]).encode()
    data = surface.sag[::-1].astype(">f8").tobytes()
    return header.ljust(-(-len(header) // BLOCK) * BLOCK) + data.ljust(-(-len(data) // BLOCK) * BLOCK, b"\0")


def _header(content: bytes) -> tuple[Header, int]:
    """The values by their keywords, and the offset of the data."""
    found: dict[str, Any] = {}
    for at in range(0, len(content) - CARD + 1, CARD):
        card = content[at : at + CARD].decode("latin-1")
        if not card.isascii() or not card.isprintable():
            raise MapFileError(f"header: card {at // CARD + 1} is no text")
        keyword = card[:8].rstrip()
        if keyword == "END" and not card[8:].strip():
            start = -(-(at + CARD) // BLOCK) * BLOCK
            if content[at + CARD : start].strip(b" "):
                raise MapFileError("header: text behind END")
            return found, start
        if not _KEYWORD.fullmatch(keyword) or (not keyword and card[8:10] == "= "):
            raise MapFileError(f"header: card {at // CARD + 1} begins with {card[:10]!r}, which is no keyword")
        if card[8:10] == "= ":
            if keyword in found:
                raise MapFileError(f"{keyword} is there twice")
            found[keyword] = _value(card[10:].strip(), keyword)
    raise MapFileError("header: no END; the file is truncated")


def _value(text: str, keyword: str) -> Any:
    if text.startswith("'"):
        return text[1:].replace("''", "\0").partition("'")[0].replace("\0", "'").strip()
    text = text.partition("/")[0].strip()
    if text in ("T", "F", ""):
        return text == "T" if text else ""
    for kind in (int, float):
        try:
            return kind(text.replace("D", "E"))
        except ValueError:
            continue
    raise MapFileError(f"{keyword} = {text!r}: must be a number, a text in quotes, T or F")


def _layout(header: Header) -> tuple[int, int, str]:
    """Width, height and type of the image."""
    for name, allowed in (("BITPIX", _TYPES), ("NAXIS", (2,))):
        if header.get(name) not in allowed:
            raise MapFileError(f"{name} = {header.get(name)}: must be one of {', '.join(map(str, allowed))}")
    sizes = [header.get(name) for name in ("NAXIS1", "NAXIS2")]
    if not all(type(size) is int for size in sizes):
        raise MapFileError(f"NAXIS1, NAXIS2 = {sizes}: must be whole numbers")
    return int(sizes[0] or 0), int(sizes[1] or 0), _TYPES[header["BITPIX"]]


def _real(header: Header, name: str, otherwise: float) -> float:
    value = header.get(name, otherwise)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MapFileError(f"{name} = {value!r}: must be a finite number")
    return float(value)


def _unit(text: str, name: str) -> float:
    """m per unit."""
    if not text:
        raise MapFileError(f"{name} is missing: the values have no unit; set xyz_unit of the interferometer")
    plain = text.strip().lower().removesuffix("s")
    metres = METRES.get(_SPOKEN.get(plain, plain))
    if metres is None:
        raise MapFileError(f"{name} = {text!r}: must be a length: {', '.join(METRES)}")
    return metres


def _pitch(header: Header) -> float | None:
    """m per pixel, from PUPLSCAL, or from CDELT if CUNIT is a length; None = not given."""
    if "PUPLSCAL" in header:
        return check_pitch(_real(header, "PUPLSCAL", 0.0))
    if not {"CDELT1", "CDELT2", "CUNIT1", "CUNIT2"} <= header.keys():
        return None
    x, y = (
        abs(_real(header, f"CDELT{axis}", 0.0)) * _unit(str(header.get(f"CUNIT{axis}", "")), f"CUNIT{axis}")
        for axis in (1, 2)
    )
    if abs(x - y) > SQUARE_TOLERANCE * x:
        raise MapFileError(f"CDELT1, CDELT2: pixels of {x:g} m x {y:g} m: must be square")
    return check_pitch(x)


def _time(text: str) -> float | None:
    """s since the epoch, of a DATE-OBS, in UTC unless it states an offset; None = none, or without a time of day."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() if "T" in text else None
