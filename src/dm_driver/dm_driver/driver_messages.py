"""Makes the messages of `pdm_driver` from its ROS-free parts."""

from __future__ import annotations

import array
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, MirrorInfo

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import doubles, mirror_info_of, time_message
from dm_driver.commands.mirror_hold import MirrorHold
from dm_driver.driver_configuration import DriverConfiguration
from dm_driver.moves import Kind, WriterState


def driver_state(state: WriterState) -> int:
    """The ActuatorState constant for a configured driver."""
    if not state.link_up:
        return int(ActuatorState.STATE_LINK_LOST)
    if state.moving is Kind.SAFE:
        return int(ActuatorState.STATE_SAFING)
    return int(ActuatorState.STATE_ACTIVE if state.enabled else ActuatorState.STATE_INACTIVE)


def unconfigured_message(frame_id: str, refusal: Refusal | None, hold: MirrorHold) -> ActuatorState:
    """The state of a driver that has no valid configuration."""
    message = ActuatorState(driver_state=ActuatorState.STATE_UNCONFIGURED)
    message.header.frame_id = frame_id
    message.holder, message.holding = hold.holder, hold.sentence
    if refusal is not None:
        message.error_code, message.message = refusal.error_code, str(refusal)
    return message


def state_message(
    state: WriterState,
    refusal: Refusal | None,
    configuration: DriverConfiguration,
    frame_id: str,
    hold: MirrorHold,
) -> ActuatorState:
    """The state of a configured driver; `refusal` of the last command, None when it was carried out."""
    message = unconfigured_message(frame_id, refusal, hold)
    message.driver_state = driver_state(state)
    message.header.stamp = time_message(state.stamp_ns)
    message.sequence = state.sequence
    message.moving = state.moving is not None
    message.history_known = state.history_known
    message.degausses, message.turns = state.degausses, state.turns
    if not state.link_up:
        inactive = refusal or "the driver is not active"
        waits = "" if state.enabled else f"{inactive}, and the drive electronics are unreachable: "
        message.error_code, message.message = ErrorCode.ELECTRONICS_UNREACHABLE, f"{waits}{state.fault}"
    connected = configuration.output.connected
    flags = np.where(connected, 0, ActuatorState.FLAG_UNUSED).astype(np.uint8)
    if refusal is not None and refusal.actuators is not None:
        flags[refusal.actuators] |= ActuatorState.FLAG_REFUSED
    if state.requested is not None and state.applied is not None and state.volts is not None:
        message.requested = doubles(state.requested)
        message.applied = doubles(state.applied)
        if configuration.electronics.knows_volts:
            message.volts = doubles(state.volts)
        if state.turned_at is not None:
            message.turned_at = doubles(state.turned_at)
        limits = configuration.limiter.limits
        # Quantisation may leave a signal up to one code short of its limit.
        code = configuration.output.scale.resolution
        at_limit = (state.applied <= limits.low + code) | (state.applied >= limits.high - code)
        flags[connected & at_limit] |= ActuatorState.FLAG_AT_LIMIT
        if message.moving:
            flags[connected & (np.abs(state.requested - state.applied) > code)] |= ActuatorState.FLAG_RAMPING
    message.flags = array.array("B", flags.tobytes())
    return message


def mirror_info_message(
    values: Mapping[str, Any], configuration: DriverConfiguration, frame_id: str, now: Any
) -> MirrorInfo:
    """Geometry and limits, for calibration and control. `now` is a time message."""
    scale = configuration.output.scale
    knows_volts = configuration.electronics.knows_volts
    message = mirror_info_of(
        configuration.mirror,
        full_aperture_diameter=values["mirror.full_aperture_diameter"],
        slew_rate_max=configuration.limiter.limits.slew_rate,
        volts_min=scale.volts_min if knows_volts else math.nan,
        volts_max=scale.volts_max if knows_volts else math.nan,
        safe_signals=doubles(configuration.safe_shape),
        wiring=values["mirror.wiring"],
        channels=array.array("i", configuration.output.channels.astype(np.int32).tobytes()),
        electronics=values["electronics.kind"],
    )
    message.header.frame_id = frame_id
    message.header.stamp = now
    return message
