"""The parameters that correct differences from the configuration, as found by a poke check."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dm_calibration.influence.poke_check import PokeCheck
from dm_calibration.optics.orientation import Orientation
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror

#: Share of its radius by which the aperture may extend beyond the map: few sampling points lie there.
OVERHANG = 0.02

#: Parameters by node.
Changes = Mapping[str, Mapping[str, Any]]


def poke_cure(check: PokeCheck, mirror: Mirror, last: Measurement, channels: Sequence[int]) -> tuple[Changes, str]:
    """Parameters with which the poke check passes; they cannot cure dead, weak and doubled actuators, signs and scale.

    Rotation and mirror image are corrected by the orientation of the maps. A calibration is made in the frame of the
    configured positions, so it remains valid when the mirror or the camera is turned.

    Args:
        last: a map of the run.
        channels: (N,) connector channel of each actuator, as configured; empty = not known.

    Returns:
        The parameters, and a sentence on anything that they cannot cure; "" = nothing.
    """
    beyond = ""
    changes: dict[str, dict[str, Any]] = {}
    found = check.registration
    if check.turned and found is not None:
        orientation = Orientation(*last.orientation).after(found.turn, found.mirrored)
        changes["interferometer"] = {
            "orientation.flip_x": orientation.flip_x,
            "orientation.flip_y": orientation.flip_y,
            "orientation.rotate_deg": round(orientation.rotate_deg, 2),
        }
        # Without a lateral resolution of the map its valid region is taken to be the mirror's aperture.
        metres = last.pitch or (mirror.working_radius / last.radius_px if last.radius_px else 0.0)
        middle = 0.5 * (np.array(last.camera) - 1.0)
        follow = any(last.followed)
        # Mirror centre, m: from the map's centre, about which the orientation turns, and from the parameters' origin.
        seen, centre = (
            complex(last.centre[0] - origin[0], origin[1] - last.centre[1]) * metres + complex(*found.shift)
            for origin in (middle, last.followed if follow else middle)
        )
        centre *= complex(np.exp(-1j * found.turn))
        if found.mirrored:
            centre = -centre.conjugate()
        reach = np.abs((seen.real, seen.imag)) + (1.0 - OVERHANG) * mirror.working_radius
        if not metres:
            beyond = "the lateral resolution of the maps is not known, so the aperture stays as it is: set pitch"
        elif not (all(last.camera) and np.isfinite(centre)):
            beyond = "where the aperture lies on the maps is not known, so it stays as it is"
        elif (reach > (middle + 0.5) * metres).any():
            beyond = (
                "the maps end before the working aperture does when it is centred on the mirror: move the mirror or "
                f"the camera by {-1e3 * seen.real:+.2f} mm in x and {-1e3 * seen.imag:+.2f} mm in y of the maps"
            )
        else:
            changes["interferometer"] |= {
                "aperture.radius": mirror.working_radius,
                "aperture.follow": follow,
                "aperture.centre_x": round(centre.real, 6),
                "aperture.centre_y": round(centre.imag, 6),
            }
            if not last.pitch:  # with an aperture in m, a map without a pitch would be refused
                changes["interferometer"]["pitch"] = float(metres)
    own = np.arange(check.place.size)
    if len(channels) == own.size and (check.place != own).any():
        # The channel that is configured for actuator i moves the one at place[i].
        order = np.argsort(check.place)
        changes["pdm_driver"] = {
            "mirror.wiring": "custom",
            "mirror.channels": [int(channels[actuator]) for actuator in order],
        }
    return changes, beyond


def parameter_text(changes: Changes) -> str:
    """`changes` as part of a parameter file; "" = there are none."""
    lines = []
    for node, values in changes.items():
        lines += [f"/**/{node}:", "  ros__parameters:"]
        lines += [f"    {name}: {_literal(value)}" for name, value in values.items()]
    return "\n".join(lines)


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_literal, value))}]"
    # Always with a point and without an exponent: else YAML 1.1 makes a string, or ROS 2 an integer, of it.
    return np.format_float_positional(value, precision=12, min_digits=6) if isinstance(value, float) else str(value)
