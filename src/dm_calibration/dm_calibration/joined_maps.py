"""Maps of several calibrations for one fit: only when they measure the same mirror in the same way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.influence.maps import MapSet, same_points

#: Largest relative differences of aperture radius and wavelength within one fit: those of the same instrument told
#: twice.
APERTURE_TOLERANCE = 1e-3
WAVELENGTH_TOLERANCE = 1e-4


def joined_maps(calibrations: Sequence[Calibration]) -> MapSet:
    """The maps of all `calibrations` as one set, labels preceded by the calibration's id.

    Raises:
        ValueError: none given, or they differ in mirror, actuators, aperture, wavelength or sampling points.
    """
    if not calibrations:
        raise ValueError("no calibration given: at least one is needed")
    first, maps = calibrations[0], [calibration.maps for calibration in calibrations]
    for other in calibrations[1:]:
        if difference := _difference(first, other):
            raise ValueError(f"calibrations {first.id} and {other.id}: {difference}; fit each on its own")
    steps = np.cumsum([0, *(int(each.step.max()) + 1 for each in maps)])
    columns: dict[str, Any] = {
        "points": maps[0].points,
        "label": tuple(f"{c.id}/{label}" for c in calibrations for label in c.maps.label),
        "step": np.concatenate([each.step + offset for each, offset in zip(maps, steps[:-1], strict=True)]),
    }
    for field in fields(MapSet):
        if field.name in columns:
            continue
        values = [getattr(each, field.name) for each in maps]
        columns[field.name] = sum(values, ()) if isinstance(values[0], tuple) else np.concatenate(values)
    return MapSet(**columns)


def _difference(one: Calibration, other: Calibration) -> str:
    """What keeps the maps of two calibrations out of one fit, in words; "" = nothing."""
    if one.mirror_serial != other.mirror_serial or one.maps.actuators != other.maps.actuators:
        return (
            f"of different mirrors, {one.mirror_serial!r} with {one.maps.actuators} actuators and "
            f"{other.mirror_serial!r} with {other.maps.actuators}"
        )
    if abs(one.aperture_radius - other.aperture_radius) > APERTURE_TOLERANCE * one.aperture_radius:
        return (
            f"aperture radius {one.aperture_radius * 1e3:.3f} mm and {other.aperture_radius * 1e3:.3f} mm, "
            f"must agree within {APERTURE_TOLERANCE:.1%}"
        )
    if abs(one.wavelength - other.wavelength) > WAVELENGTH_TOLERANCE * max(one.wavelength, other.wavelength):
        return (
            f"wavelength {one.wavelength * 1e9:.3f} nm and {other.wavelength * 1e9:.3f} nm (0 = not told), "
            f"must agree within {WAVELENGTH_TOLERANCE:.2%}"
        )
    if not same_points(one.maps.points, other.maps.points):
        return "sampled at different points"
    if one.maps.terms != other.maps.terms:
        return f"{one.maps.terms} and {other.maps.terms} Zernike terms"
    return ""
