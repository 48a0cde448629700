"""Feedback of the long actions in words."""

from __future__ import annotations

from typing import Any

PHASES = ("degauss", "pokes", "surfaces", "fit", "store", "hysteresis")


def calibration_step(feedback: Any) -> str:
    """Feedback of the action `calibrate`: phase, what is measured, what was dropped."""
    dropped = f", {feedback.maps_dropped} dropped" if feedback.maps_dropped else ""
    phase = PHASES[feedback.phase] if feedback.phase < len(PHASES) else "?"
    return f"{phase} {feedback.label}{dropped}"


def converge_step(feedback: Any) -> str:
    """Feedback of the action `converge`: the map and how far off it was."""
    return f"map {feedback.step}: largest coefficient {feedback.max_zernike * 1e9:.1f} nm"


def recipe_step(feedback: Any) -> str:
    """Feedback of the action `build_recipes`: the curvature, the map and how far off it was."""
    return f"{feedback.curvature:+.4f} 1/m, {converge_step(feedback)}"
