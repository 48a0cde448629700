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

#: Arrays of finite numbers, and arrays in which NaN has the given meaning.
_ARRAYS = ("gain", "offset", "thermal", "crept", "covariance")
_OR_NAN = {
    "stuck": "an actuator moves",
    "failing": "an actuator follows its commands",
    "temperatures": "it is not known",
}
_NUMBERS = ("stamp_ns", "revision", "checked_ns", "surprising")
#: Names of the evidence, missing in older files, with values that give a trust of exactly 1, with which those updates
#: were used; and figures missing in older files, with what they were then.
_EVIDENCE = {"foretold": 100.0, "borne_out": 110.0, "warm_foretold": 0.0, "warm_borne_out": 0.0}
_FIGURES = {"disagreement": 0.0, "misfit": 1.0}
_RESULT = ("influence_zernike", "zernike_offset", "influence_sag", "sag_offset")


class UpdatesFileError(ValueError):
    """A file of updates is damaged, foreign, or of another calibration; the message says which."""


def _head(calibration: Calibration) -> dict[str, Attribute]:
    """Attributes that tie a file to its calibration: its id, and a SHA-256 over influence function, figure, points and
    hysteresis. Recipes and notes are left out, since they may be added later.
    """
    columns: dict[str, Column] = {name: getattr(calibration.fit, name) for name in _RESULT}
    columns |= {f"points/{name}": getattr(calibration.fit.points, name) for name in ("x", "y", "weight")}
    basis = content_hash(columns | hysteresis_columns(calibration.hysteresis), {"id": calibration.id})
    tied = {"calibration": calibration.id, "basis_sha256": basis}
    return {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **tied}


def write_updates(path: Path, calibration: Calibration, updates: Drift) -> None:
    """Write `updates` of `calibration`.

    Raises:
        OSError: it could not be written; the previous file is unchanged.
    """
    columns: dict[str, Column] = {name: getattr(updates, name) for name in (*_ARRAYS, *_OR_NAN)}
    attributes: dict[str, Attribute] = {
        **_head(calibration),
        **{name: getattr(updates, name) for name in (*_NUMBERS, *_FIGURES)},
        **dict(zip(_EVIDENCE, updates.evidence.ravel().tolist(), strict=True)),
    }
    write_whole(path, write_image(columns, attributes))


def read_updates(path: Path, calibration: Calibration, like: Drift) -> Drift | None:
    """The updates of `calibration` in a file; None when there is no file.

    Args:
        like: its arrays have the required shapes, and the values for arrays that older files lack.

    Raises:
        UpdatesFileError: damaged, foreign, or of another calibration.
    """
    if not path.exists():
        return None
    try:
        columns, attributes = read_image(path)
    except ImageError as error:
        raise UpdatesFileError(f"{path.name}: {error}") from error
    for name, wanted in _head(calibration).items():
        if attributes.get(name) != wanted:
            raise UpdatesFileError(f"{path.name}: {name} is {attributes.get(name)!r}: must be {wanted!r}")
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
    # Older files lack these: then all actuators moved and followed, and the temperature was not known.
    arrays |= {name: columns.get(name, getattr(like, name)) for name in _OR_NAN}
    for name, value in arrays.items():
        shape, nan = getattr(like, name).shape, name in _OR_NAN
        allowed = f"numbers, NaN where {_OR_NAN[name]}" if nan else "finite numbers"
        right = isinstance(value, np.ndarray) and value.shape == shape and np.isfinite(value) | (nan & np.isnan(value))
        if not np.all(right):
            raise UpdatesFileError(f"{path.name}: {name} must be {shape} {allowed}")
    figures = {name: attributes.get(name, before) for name, before in (_EVIDENCE | _FIGURES).items()}
    for name, number in figures.items():
        if not isinstance(number, float) or not np.isfinite(number):
            raise UpdatesFileError(f"{path.name}: {name} is {number!r}: must be a finite number")
    evidence = np.reshape([figures.pop(name) for name in _EVIDENCE], (2, 2))
    found: dict[str, Any] = {**arrays, **numbers, **figures}
    return Drift(**found, evidence=evidence)
