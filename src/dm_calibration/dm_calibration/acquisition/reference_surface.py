"""The instrument's own error: a map of it, which is subtracted from every other. What is left is absolute."""

from pathlib import Path

from dm_calibration.map_files import MapFileError, SurfaceMap, read_map
from dm_calibration.map_files.surface_map import PITCH_TOLERANCE
from dm_calibration.optics.aperture import MapRejectedError
from dm_common import Floats


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


def absolute_sag(source: SurfaceMap, reference: SurfaceMap, pitch: float, wavelength_tolerance: float) -> Floats:
    """(height, width) m, of a map as the instrument shows it, less the reference surface; NaN where either has no data.

    Args:
        pitch: of files that do not tell it, m per pixel; 0 = not known.

    Raises:
        MapRejectedError: another size, place on the camera, pitch or wavelength than the reference surface, or a map
            from which the instrument has subtracted its error already.
    """
    size = "{1} x {0} pixels from column {2}, row {3} of the camera"
    here, there = ((*each.sag.shape, *each.origin) for each in (source, reference))
    pitches = [each.pitch or pitch for each in (source, reference)]
    different = ""
    if here != there:
        different = f"{size.format(*here)}, reference_surface has {size.format(*there)}"
    elif all(pitches) and abs(pitches[0] - pitches[1]) > PITCH_TOLERANCE * pitches[1]:
        different = f"pitch {pitches[0] * 1e6:.3f} um, reference_surface has {pitches[1] * 1e6:.3f} um"
    elif reference.wavelength and abs(source.wavelength - reference.wavelength) > wavelength_tolerance:
        different = (
            f"wavelength {source.wavelength * 1e9:.3f} nm, reference_surface has {reference.wavelength * 1e9:.3f} nm"
        )
    elif source.system_error_subtracted:
        different = (
            "the instrument has subtracted its own error already: leave reference_surface empty, or switch that off"
        )
    if different:
        raise MapRejectedError(different)
    return source.sag - reference.sag
