"""The failures a request to the node `calibration` can meet, and their codes."""

from __future__ import annotations

from dm_msgs.msg import ErrorCode

from dm_calibration.calibration import CalibrationFileError
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.applied_history import MapNotUsableError
from dm_calibration.regression.stepwise import CollinearError, TooFewSamplesError
from dm_calibration.store.calibration_store import StoreError, UnknownCalibrationError
from dm_common.measurement import BenchError, Cancelled
from dm_common.names import UnknownNameError
from dm_common.optics.sample_regions import EmptyRegionError


class Refused(Exception):
    """A request cannot be served; `code` is a value of ErrorCode."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


def error_code(error: Exception) -> int:
    """The ErrorCode of an exception of the calibration library."""
    if isinstance(error, Refused | BenchError):
        return error.code
    codes: tuple[tuple[type[Exception], int], ...] = (
        (Cancelled, ErrorCode.CANCELED),
        (StoreError, ErrorCode.STORAGE_FAILED),
        (MapNotUsableError, ErrorCode.MAP_REJECTED),
        (TooFewMapsError, ErrorCode.TOO_FEW_MAPS),
        (TooFewSamplesError, ErrorCode.TOO_FEW_MAPS),
        (CollinearError, ErrorCode.TOO_FEW_MAPS),
        (EmptyRegionError, ErrorCode.MAP_INSUFFICIENT),
        (CalibrationFileError, ErrorCode.CALIBRATION_UNREADABLE),
        (UnknownNameError, ErrorCode.UNKNOWN_NAME),
        (UnknownCalibrationError, ErrorCode.UNKNOWN_NAME),
        (ValueError, ErrorCode.INVALID_ARGUMENT),
    )
    for kind, code in codes:
        if isinstance(error, kind):
            return code
    raise error


#: Failures that are answered with a code and a message; anything else is a defect.
EXPECTED = (Refused, BenchError, Cancelled, StoreError, ValueError)
