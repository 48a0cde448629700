"""Interferometer map ingest and calibration of deformable mirrors: `calibrate` makes a calibration of maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dm_calibration.calibrator import calibrate

__all__ = ["calibrate"]


def __getattr__(name: str) -> Any:
    # When it is asked for: the process that reads HDF5 files imports this package too, and must stay small.
    if name == "calibrate":
        from dm_calibration.calibrator import calibrate

        return calibrate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
