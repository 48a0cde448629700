"""Detection, by reference frames, of a mirror that was bumped in the middle of a run.

All reference frames show the same command. Between two of them the map may change by remaining hysteresis and by a
little drift; a larger change of tilt, position on the camera or figure means that the mirror was bumped.
"""

import math
from dataclasses import dataclass

import numpy as np

from dm_calibration.influence.maps import StepKind
from dm_common import Floats
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS
from dm_common.values import live_parameter, real

#: Uncertainty of the position of an aperture found on a map, pixels.
_WANDER_PX = 1.5
#: Factor on the allowance: errors of actuators that moved together exceed the rms sum of independent ones, 1.3 to 1.6
#: times in a run in which only the held shapes are close to a bowl in one half, and to its inverse in the other.
_TOGETHER = 2.0


@dataclass(frozen=True)
class BumpOptions:
    """Largest changes between two reference frames; 0 = not checked."""

    tilt_max: float = live_parameter(
        real(3e-6, 0.0, 1e-3, "m"),
        "Largest change of tilt between two reference frames, as sag at the edge; 0 = not checked.",
    )
    shift_max: float = live_parameter(
        real(1e-4, 0.0, 1e-2, "m"),
        "Largest shift of the aperture in the map between two reference frames, on the mirror; 0 = not checked.",
    )
    figure_max: float = live_parameter(
        real(50e-9, 0.0, 1e-3, "m"),
        "Largest rms change of the figure between two reference frames, beyond what twice `hysteresis_allowance` "
        "explains; 0 = not checked.",
    )


class BumpCheck:
    """Compares each reference frame with the one before it."""

    def __init__(self, options: BumpOptions, mirror: Mirror, allowance: float) -> None:
        """`allowance`: error of an actuator by hysteresis, as a share of its move."""
        self._options, self._allowance = options, allowance
        self._rest, self._half_range, self._radius = mirror.rest, mirror.limits.half_range, mirror.working_radius
        self._last: Measurement | None = None
        self._moved = np.zeros_like(self._rest)
        # Sums of squares: change in the maps (rms, m) and commanded change. The root of their ratio is the response.
        self._shown = self._commanded = 0.0

    def take(self, record: Measurement) -> None:
        """Take a good map; later reference frames are compared with it."""
        if record.kind == StepKind.REFERENCE:
            self._last = record
            self._moved = np.zeros_like(self._moved)
            return
        self.moved(record.applied)
        if self._last is not None and np.isfinite(record.coefficients).all():
            self._shown += _figure_rms(record.coefficients - self._last.coefficients) ** 2
            away = record.applied - self._rest
            # A signal common to all actuators lifts the plate without bending it.
            self._commanded += float(np.square(away - (away.mean() if len(away) > 1 else 0.0)).sum())

    def moved(self, applied: Floats) -> None:
        """Note that the signals `applied` (N,) were written, whether or not a map follows."""
        self._moved = np.maximum(self._moved, np.abs(applied - self._rest))

    def degaussed(self) -> None:
        """Note that all actuators have moved through their whole range."""
        self._moved = np.maximum(self._moved, self._half_range)

    def change(self, frame: Measurement, interrupted: bool) -> str:
        """How the reference frame `frame` differs from the one before it; "" = within the allowed changes.

        Args:
            interrupted: the run was interrupted, so the instrument may have been realigned; tilt is not checked.
        """
        if self._last is None:
            return ""
        last, options = self._last, self._options
        difference = frame.coefficients - last.coefficients
        tilt = float(np.hypot(difference[1], difference[2]))
        if options.tilt_max and not interrupted and tilt > options.tilt_max:
            return (
                f"the tilt changed by {tilt * 1e6:.2f} um at the edge since {last.label} "
                f"(bump.tilt_max {options.tilt_max * 1e6:.2f} um)"
            )
        shift = math.dist(self._centre(frame), self._centre(last))
        pixel = self._radius / frame.radius_px if frame.radius_px > 0.0 else 0.0
        if options.shift_max and shift > max(options.shift_max, _WANDER_PX * pixel):
            return (
                f"the mirror moved by {shift * 1e3:.3f} mm on the map since {last.label} "
                f"(bump.shift_max {options.shift_max * 1e3:.3f} mm)"
            )
        left = self._left_behind()
        figure = _figure_rms(difference)
        if options.figure_max and figure > options.figure_max + left:
            return (
                f"the figure changed by {figure * 1e9:.0f} nm rms since {last.label} (bump.figure_max "
                f"{options.figure_max * 1e9:.0f} nm and up to {left * 1e9:.0f} nm that hysteresis may have left)"
            )
        return ""

    def _centre(self, record: Measurement) -> Floats:
        """(2,) m, centre of the aperture on a map; NaN = not known."""
        return np.array(record.centre) * (self._radius / record.radius_px if record.radius_px > 0.0 else np.nan)

    def _left_behind(self) -> float:
        """The largest rms sag that hysteresis may have left since the last reference frame, m."""
        if not self._moved.any():
            return 0.0
        if not self._commanded:
            return float("inf")  # no map yet shows the size of the response
        response = np.sqrt(self._shown / self._commanded)
        return float(_TOGETHER * self._allowance * response * np.linalg.norm(self._moved))


def _figure_rms(coefficients: Floats) -> float:
    """Rms sag without piston and tilt, m."""
    return float(np.linalg.norm(coefficients[PISTON_TILT:] * TERM_RMS[PISTON_TILT : coefficients.size]))
