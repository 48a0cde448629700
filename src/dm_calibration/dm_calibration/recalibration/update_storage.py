"""The file with the updates of a calibration: tied to it by id and content, written whole or not at all."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from dm_calibration.calibration import Calibration
from dm_calibration.recalibration.drift import Drift
from dm_calibration.store.hdf5_image import Attribute, Column, ImageError, content_hash, read_image, write_image
from dm_calibration.store.hysteresis_storage import hysteresis_columns
from dm_common.atomic_write import write_whole

SCHEMA = "dm_calibration/updates"
SCHEMA_VERSION = 1

_ARRAYS = ("gain", "offset", "thermal", "crept", "covariance")
_NUMBERS = ("stamp_ns", "revision", "checked_ns", "surprising")
#: Not in files of before there were such figures: what they hold was used whole, and is: a trust of exactly 1.
_FIGURES = {"foretold": 100.0, "borne_out": 110.0, "warm_foretold": 0.0, "warm_borne_out": 0.0, "disagreement": 0.0}
_RESULT = ("influence_zernike", "zernike_offset", "influence_sag", "sag_offset")


class UpdatesFileError(ValueError):
    """A file of updates is damaged, foreign, or of another calibration; the message says which."""


def basis_hash(calibration: Calibration) -> str:
    """SHA-256 over what updates change: influence function, points, hysteresis. Recipes, notes may be added later."""
    columns: dict[str, Column] = {name: getattr(calibration.fit, name) for name in _RESULT}
    columns |= {f"points/{name}": getattr(calibration.fit.points, name) for name in ("x", "y", "weight")}
    return content_hash(columns | hysteresis_columns(calibration.hysteresis), {"id": calibration.id})


def write_updates(path: Path, identifier: str, basis: str, updates: Drift) -> None:
    """Write `updates` of the calibration `identifier` with the hash `basis`.

    Raises:
        OSError: what stood there before still does.
    """
    columns: dict[str, Column] = {name: getattr(updates, name) for name in (*_ARRAYS, "stuck", "temperatures")}
    attributes: dict[str, Attribute] = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "calibration": identifier,
        "basis_sha256": basis,
        **{name: getattr(updates, name) for name in _NUMBERS},
        **dict(zip(_FIGURES, (*updates.evidence.ravel().tolist(), updates.disagreement), strict=True)),
    }
    write_whole(path, write_image(columns, attributes))


def read_updates(path: Path, identifier: str, basis: str, like: Drift) -> Drift | None:
    """The updates in a file; None when there is no file.

    Args:
        like: with arrays of the shapes that must be there.

    Raises:
        UpdatesFileError: damaged, foreign, or of another calibration.
    """
    if not path.exists():
        return None
    try:
        columns, attributes = read_image(path)
    except ImageError as error:
        raise UpdatesFileError(f"{path.name}: {error}") from error
    wanted = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "calibration": identifier, "basis_sha256": basis}
    for name, value in wanted.items():
        if attributes.get(name) != value:
            raise UpdatesFileError(f"{path.name}: {name} is {attributes.get(name)!r}: must be {value!r}")
    numbers = {name: attributes.get(name) for name in _NUMBERS}
    for name, number in numbers.items():
        if not isinstance(number, int) or number < 0:
            raise UpdatesFileError(f"{path.name}: {name} is {number!r}: must be a whole number from 0")
    arrays = {name: columns.get(name) for name in _ARRAYS}
    covariance = arrays["covariance"]
    later = {name: getattr(like, name) for name in ("thermal", "crept") if name not in columns}
    if later and isinstance(covariance, np.ndarray) and covariance.ndim == 2:
        size = len(like.covariance) - sum(map(len, later.values()))
        arrays |= later | {"covariance": block_diag(covariance, like.covariance[size:, size:])}
    for name, value in arrays.items():
        shape = getattr(like, name).shape
        if not isinstance(value, np.ndarray) or value.shape != shape or not np.isfinite(value).all():
            raise UpdatesFileError(f"{path.name}: {name} must be {shape} finite numbers")
    # Before these were kept all actuators moved, and nothing was known of the temperature.
    for name, meaning in (("stuck", "an actuator moves"), ("temperatures", "it is not known")):
        arrays[name] = value = columns.get(name, getattr(like, name))
        shape = getattr(like, name).shape
        if not isinstance(value, np.ndarray) or value.shape != shape or np.isinf(value).any():
            raise UpdatesFileError(f"{path.name}: {name} must be {shape} numbers, NaN where {meaning}")
    figures = {name: attributes.get(name, before) for name, before in _FIGURES.items()}
    for name, number in figures.items():
        if not isinstance(number, float) or not np.isfinite(number):
            raise UpdatesFileError(f"{path.name}: {name} is {number!r}: must be a finite number")
    found: dict[str, Any] = {**arrays, **numbers, "disagreement": figures.pop("disagreement")}
    return Drift(**found, evidence=np.reshape(list(figures.values()), (2, 2)))
