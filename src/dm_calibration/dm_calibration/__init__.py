"""Interferometer map ingest and calibration of deformable mirrors.

`calibrate` makes a calibration from maps; `identify_response` compares hysteresis laws on any linear measurement.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dm_calibration.calibrator import calibrate
    from dm_calibration.hysteresis.response_fit import identify_response

__all__ = ["calibrate", "identify_response"]
_FROM = {"calibrate": "dm_calibration.calibrator", "identify_response": "dm_calibration.hysteresis.response_fit"}


def __getattr__(name: str) -> Any:
    # Imported on first use: the process that reads HDF5 files imports this package too and must stay small.
    if name not in _FROM:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_FROM[name]), name)
