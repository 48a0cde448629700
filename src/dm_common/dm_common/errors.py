"""Errors of requests, with the codes that report them, and what their sentences share. Independent of ROS."""

import difflib
from collections.abc import Iterable
from enum import IntEnum

from dm_common import Bools


class ErrorCode(IntEnum):
    """The constants of dm_msgs/ErrorCode, where each is explained; a test keeps the two alike."""

    OK = 0

    INVALID_LENGTH = 100
    NOT_FINITE = 101
    OUT_OF_RANGE = 102
    STALE = 103
    NEIGHBOUR_DIFFERENCE = 104
    UNREACHABLE = 105
    UNKNOWN_NAME = 106
    INVALID_ARGUMENT = 107
    NOT_SUPPORTED = 108
    NODE_INACTIVE = 109

    DRIVER_INACTIVE = 200
    ELECTRONICS_UNREACHABLE = 201
    DRIVER_UNAVAILABLE = 202

    INTERFEROMETER_INACTIVE = 300
    TRIGGER_FAILED = 301
    MAP_TIMEOUT = 302
    MAP_UNREADABLE = 303
    MAP_INSUFFICIENT = 304
    MAP_REJECTED = 305
    INTERFEROMETER_UNAVAILABLE = 306

    NOT_CALIBRATED = 400
    CALIBRATION_MISMATCH = 401
    CALIBRATION_UNREADABLE = 402
    STORAGE_FAILED = 403
    TOO_FEW_MAPS = 404
    BUSY = 405
    POKE_CHECK_FAILED = 406

    CANCELED = 500
    PREEMPTED = 501
    NOT_CONVERGED = 502
    TIMEOUT = 503
    INTERNAL = 599


class CodedError(RuntimeError):
    """A failure that is reported by a code and a sentence that a person can act on.

    Errors about a value, where callers expect a ValueError, derive from both classes.

    Attributes:
        error_code: a value of ErrorCode; a class attribute where all failures of the class share one.
    """

    error_code: int


class Refusal(CodedError):
    """A request that is not carried out.

    Attributes:
        actuators: (N,) bool, True for the actuators at fault; None if it is not about single actuators.
    """

    def __init__(self, error_code: int, message: str, actuators: Bools | None = None) -> None:
        super().__init__(message)
        self.error_code = error_code
        self.actuators = actuators


class MeasurementError(Refusal):
    """A single map could not be measured; another try may succeed."""


class Cancelled(CodedError):
    """A procedure was cancelled."""

    error_code = ErrorCode.CANCELED


class UnknownNameError(CodedError, ValueError):
    """An unknown name; the message lists similar names, or says where the name was searched for."""

    error_code = ErrorCode.UNKNOWN_NAME


def unknown_name(what: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """The error for `name`, listing the known names nearest to it, or all of them when there are few."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=4, cutoff=0.5) or (names if len(names) <= 12 else [])
    known_names = f"; known are {', '.join(names[:3])} to {names[-1]}" if names else ""
    hint = f"; did you mean {', '.join(near)}?" if near else known_names
    return UnknownNameError(f"{what} {name!r} is unknown{hint}")


def size_text(name: str, size: int) -> str:
    """The size of an array, as refusals of it begin: signals has 1 value, signals has 36 values."""
    return f"{name} has {size} value{'' if size == 1 else 's'}"


def beside(form: str, value: float, *limits: float) -> str:
    """A refused value in the format `form`, such as .1%, or with more digits that distinguish it from its `limits`."""
    limits = tuple(limit for limit in limits if limit != value)  # nothing tells it from these
    sign, digits = form[:-1].split(".")
    for more in range(int(digits), 17):
        text, *others = (f"{number:{sign}.{more}{form[-1]}}" for number in (value, *limits))
        if text not in others:
            break
    return text


class ClockError(CodedError, TimeoutError):
    """ROS time stands still."""

    error_code = ErrorCode.TIMEOUT


#: Message when nothing can be predicted or corrected because no calibration is in use; it says what to do.
NO_CALIBRATION = "no calibration is in use: run `./dm calibrate` or load_calibration"
#: In the message of `capabilities`, precedes the reason why the history of the actuators is not known.
HISTORY_UNKNOWN = "wider error bound: "
#: In the message of `update_calibration`, where an actuator that was given up may only be weakened.
CHECK_ANOTHER_SHAPE = "check another shape"

#: Failures that are reported by a code and a message; any other exception is a defect.
EXPECTED = (CodedError, ValueError)


def error_code(error: Exception) -> int:
    """The code of one of the EXPECTED failures: its own, or INVALID_ARGUMENT for a plain ValueError."""
    return error.error_code if isinstance(error, CodedError) else ErrorCode.INVALID_ARGUMENT
