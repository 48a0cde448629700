"""Checks of a request that need neither clock nor node."""

from __future__ import annotations

import math

from dm_msgs.msg import ActuatorState

from dm_common.errors import ErrorCode, Refusal
from dm_controller.decision import Decision

#: A message's constants are properties of its class, which take longer to look up.
_ACTIVE = ActuatorState.STATE_ACTIVE


def check_age(stamp_ns: int, now_ns: int, limit_s: float) -> None:
    """Raise Refusal when a request stamped `stamp_ns` (0 = now) is older than `limit_s` (0 = any age will do)."""
    age = 1e-9 * (now_ns - stamp_ns)
    if limit_s and stamp_ns and not -limit_s <= age <= limit_s:
        raise Refusal(ErrorCode.STALE, f"header.stamp: the request is {age:.3f} s old; allowed: {limit_s:g} s")


def check_driver(driver: ActuatorState | None) -> None:
    """Raise Refusal when the driver, by its last report, takes no commands."""
    if driver is None:
        raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "no actuator_state from pdm_driver yet: is the driver running?")
    if driver.driver_state != _ACTIVE:
        reason = f": {driver.message}" if driver.message else ""
        raise Refusal(ErrorCode.DRIVER_INACTIVE, f"pdm_driver is not active{reason}")


def check_reachable(decision: Decision, tolerance: float) -> None:
    """Raise Refusal when the limits leave a larger coefficient error than `tolerance` (m)."""
    if decision.move.max_zernike <= tolerance:
        return
    low, high = decision.reachable
    if math.isnan(low):
        words = "no curvature is reachable with these added Zernike terms"
    else:
        words = f"reachable: {low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
    raise Refusal(
        ErrorCode.UNREACHABLE,
        f"curvature = {decision.target.curvature:+.4f} 1/m: the limits of the actuators leave a coefficient error "
        f"of {decision.move.max_zernike * 1e9:.1f} nm (allowed {tolerance * 1e9:.1f} nm); {words}",
    )
