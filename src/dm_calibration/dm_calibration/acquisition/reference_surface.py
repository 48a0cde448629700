"""The instrument's own error: a map of it is subtracted from every other map, which makes results absolute."""

from pathlib import Path

from dm_calibration.map_files import MapFileError, SurfaceMap, read_map
from dm_calibration.map_files.surface_map import PITCH_TOLERANCE

#: Name of the reference surface in messages: that of the parameter with its file.
NAME = "reference_surface"


def load_reference(path: str, xyz_unit: str, wavelength: float, tolerance: float) -> SurfaceMap:
    """The reference surface in a map file.

    Args:
        wavelength: expected of the instrument, m; 0 = any.

    Raises:
        ValueError: not a readable map, or one of another wavelength.
    """
    try:
        reference = read_map(Path(path).expanduser(), xyz_unit=xyz_unit or None)
    except MapFileError as error:
        raise ValueError(f"reference_surface: {error}") from error
    if wavelength and reference.wavelength and abs(reference.wavelength - wavelength) > tolerance:
        raise ValueError(
            f"reference_surface = {path!r}: wavelength {reference.wavelength * 1e9:.3f} nm, must be "
            f"{wavelength * 1e9:.3f} nm as the instrument's (wavelength.expected)"
        )
    return reference


def difference(
    source: SurfaceMap, reference: SurfaceMap, pitch: float, wavelength_tolerance: float, name: str = NAME
) -> str:
    """Why a map cannot be compared with a reference, called `name` in the sentence; "" = it can.

    Either they differ in size, place on the camera, pitch or wavelength, or the instrument has already subtracted its
    error from the map. `pitch`: m per pixel, for files that do not contain it; 0 = not known.
    """
    size = "{1} x {0} pixels from column {2}, row {3} of the camera"
    here, there = ((*each.sag.shape, *each.origin) for each in (source, reference))
    pitches = [each.pitch or pitch for each in (source, reference)]
    if here != there:
        return f"{size.format(*here)}, {name} has {size.format(*there)}"
    if all(pitches) and abs(pitches[0] - pitches[1]) > PITCH_TOLERANCE * pitches[1]:
        return f"pitch {pitches[0] * 1e6:.3f} um, {name} has {pitches[1] * 1e6:.3f} um"
    if reference.wavelength and abs(source.wavelength - reference.wavelength) > wavelength_tolerance:
        return f"wavelength {source.wavelength * 1e9:.3f} nm, {name} has {reference.wavelength * 1e9:.3f} nm"
    if source.system_error_subtracted:
        return "the instrument has subtracted its own error already: leave reference_surface empty, or switch that off"
    return ""
