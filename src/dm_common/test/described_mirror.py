"""A mirror as the driver announces it, for tests that play the driver."""

from __future__ import annotations

from array import array
from typing import Any

from dm_msgs.msg import MirrorInfo

from dm_common.messages import doubles
from dm_common.mirror import Mirror


def mirror_info_of(mirror: Mirror, **fields: Any) -> MirrorInfo:
    """The message `mirror_info` of `mirror`, with `fields` that are not as usual."""
    limits = mirror.limits
    described: dict[str, Any] = {
        "name": mirror.name,
        "serial": mirror.serial,
        "actuators": mirror.actuators,
        "actuator_x": doubles(mirror.x),
        "actuator_y": doubles(mirror.y),
        "neighbour_a": array("I", limits.pairs[:, 0].tolist()),
        "neighbour_b": array("I", limits.pairs[:, 1].tolist()),
        "working_aperture_diameter": 2.0 * mirror.working_radius,
        "signal_min": limits.low,
        "signal_max": limits.high,
        "neighbour_difference_max": limits.neighbour_difference,
    }
    return MirrorInfo(**described | fields)
