"""Builds the parts of the driver from parameter values, and finds contradictions between them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dm_common import Floats
from dm_common.errors import Refusal, size_text
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_common.mirror import Mirror
from dm_common.values import from_values
from dm_driver.degauss import degauss_move
from dm_driver.electronics import BACK_ENDS
from dm_driver.electronics.base import DriveElectronics, ElectronicsSettings
from dm_driver.electronics.frame_format import FrameFormat
from dm_driver.output.volts import VoltScale
from dm_driver.output.wiring import OutputStage, wiring_table
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter, Shape


@dataclass(frozen=True)
class DriverConfiguration:
    """A checked configuration.

    Attributes:
        mirror: geometry and limits.
        limiter: holds writes to these limits.
        output: wiring and volts.
        safe_shape: (N,) legal signals.
        settings: how the electronics are reached.
        electronics: the back end, not yet opened.
    """

    mirror: Mirror
    limiter: SafetyLimiter
    output: OutputStage
    safe_shape: Shape
    settings: ElectronicsSettings
    electronics: DriveElectronics


def build_configuration(values: Mapping[str, Any]) -> DriverConfiguration:
    """Check the values of `driver_parameters.PARAMETERS` against each other and build the parts.

    Raises:
        ValueError: naming the parameter, its value and what is allowed.
    """
    if not values["mirror.serial"].strip():
        raise ValueError("mirror.serial is empty: must be the mirror's serial number")
    actuators = values["mirror.actuators"]
    kind = values["electronics.kind"]
    serial_port = values["electronics.serial_port"]
    settings = from_values(
        ElectronicsSettings,
        values,
        "electronics.",
        serial_port=str(Path(serial_port).expanduser()) if serial_port else "",
        channels=actuators,
        timeout_s=values["electronics.timeout"],
        frame=from_values(FrameFormat, values if kind == "framed_serial" else {}, "framed_serial."),
    )
    back_end = BACK_ENDS[kind](settings)  # raises if a setting is missing
    unit = tuple(values[f"volts.{name}"] for name in ("dac_at_zero", "dac_at_full", "amplifier_gain"))
    if not back_end.knows_volts and unit != (0.0, 1.0, 1.0):
        raise ValueError(
            "volts.dac_at_zero, volts.dac_at_full, volts.amplifier_gain = {:g}, {:g}, {:g}: must be 0, 1, 1 with"
            " electronics.kind = {!r}, which takes numbers from 0 to 1 and not volts".format(*unit, kind)
        )
    channel_of_actuator = wiring_table(values["mirror.wiring"], values["mirror.channels"], actuators, back_end.channels)
    scale = VoltScale(
        max_code=back_end.max_code,
        dac_volts_at_zero=values["volts.dac_at_zero"],
        dac_volts_at_full=values["volts.dac_at_full"],
        amplifier_gain=values["volts.amplifier_gain"],
        volts_min=values["volts.min"],
        volts_max=values["volts.max"],
        law=values["drive.law"],
    )
    x, y = _positions(values, actuators)
    if values["mirror.working_aperture_diameter"] > values["mirror.full_aperture_diameter"]:
        raise ValueError(
            f"mirror.working_aperture_diameter = {values['mirror.working_aperture_diameter']:g} m: must be at most"
            f" mirror.full_aperture_diameter = {values['mirror.full_aperture_diameter']:g} m"
        )
    step = values["limits.step"] / back_end.frames_per_step
    limits = from_values(
        DriverLimits,
        values,
        "limits.",
        step=step,
        slew_rate=min(values["limits.slew_rate"], step * back_end.frames_per_second),
        frames_per_second=back_end.frames_per_second,
        actuators=actuators,
        low=values["limits.signal_min"],
        high=values["limits.signal_max"],
        pairs=neighbour_pairs(x, y),
    )
    if limits.step < scale.resolution:
        raise ValueError(
            f"limits.step = {values['limits.step']:g}: must be at least "
            f"{scale.resolution * back_end.frames_per_step:.3g}, the signal of one DAC code per frame"
        )
    limiter = SafetyLimiter(limits)
    try:
        at_zero = min(max(scale.signal_at_zero, limits.low), limits.high)
        safe_shape = limiter.check_shape(values["safe_signals"] or np.full(actuators, at_zero), "safe_signals")
        steps, longest = values["degauss.steps"], values["degauss.duration_max"]
        degauss_move(limits, 0.0, steps, safe_shape, longest, "degauss.steps")
    except Refusal as refusal:
        raise ValueError(str(refusal)) from refusal
    doubt = math.floor(limits.step / scale.resolution) if values["electronics.await_arrival"] else 0
    settings = replace(settings, doubt=doubt)
    return DriverConfiguration(
        mirror=Mirror(
            values["mirror.name"],
            values["mirror.serial"],
            x,
            y,
            0.5 * values["mirror.working_aperture_diameter"],
            limits,
        ),
        limiter=limiter,
        output=OutputStage(scale, channel_of_actuator, back_end.channels),
        safe_shape=safe_shape,
        settings=settings,
        electronics=BACK_ENDS[kind](settings),
    )


def _positions(values: Mapping[str, Any], actuators: int) -> tuple[Floats, Floats]:
    x = np.array(values["mirror.actuator_x"], dtype=np.float64)
    y = np.array(values["mirror.actuator_y"], dtype=np.float64)
    if x.size == 0 and y.size == 0:
        return hexagonal_positions(
            actuators,
            values["mirror.pitch"],
            values["mirror.start_angle"],
            values["mirror.clockwise"],
            values["mirror.reflected"],
        )
    for name, ordinates in (("mirror.actuator_x", x), ("mirror.actuator_y", y)):
        if ordinates.size != actuators:
            raise ValueError(
                f"{size_text(name, ordinates.size)}: must have {actuators} (mirror.actuators), or both be empty"
            )
    return x, y
