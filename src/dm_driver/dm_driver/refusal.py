"""Why a command is refused, in a type that the ROS-free parts share."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Reason(IntEnum):
    """The values of dm_msgs/ErrorCode that the driver uses."""

    OK = 0
    INVALID_LENGTH = 100
    NOT_FINITE = 101
    OUT_OF_RANGE = 102
    STALE = 103
    NEIGHBOUR_DIFFERENCE = 104
    INVALID_ARGUMENT = 107
    DRIVER_INACTIVE = 200
    ELECTRONICS_UNREACHABLE = 201
    PREEMPTED = 501
    INTERNAL = 599


class Refusal(Exception):
    """A command that is not carried out; the mirror keeps its shape.

    Attributes:
        reason: why, as in dm_msgs/ErrorCode.
        actuators: (N,) bool, True for the actuators at fault; None when it is not about single actuators.
    """

    def __init__(self, reason: Reason, message: str, actuators: NDArray[np.bool_] | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.actuators = actuators
