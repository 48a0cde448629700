"""From messages to what is drawn: pure functions, without a browser and without ROS calls."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, Capabilities, FocusRequest
from matplotlib import colormaps
from matplotlib.colors import to_hex

from dm_common import SIGMAS_95, Floats
from dm_common.figures import with_point
from dm_common.optics.zernike import NAMES, PISTON_TILT, SPOKEN
from dm_tools.running_suite import saturation_text

SIGNAL_COLOURS = colormaps["cividis"]  # taken once: each time Matplotlib makes a copy, whose table it computes anew
QUALITIES = {
    Capabilities.UNCALIBRATED: "uncalibrated",
    Capabilities.APPROXIMATE: "approximate",
    Capabilities.CALIBRATED: "calibrated",
}
MODES = {
    FocusRequest.MODE_AUTO: "Automatic",
    FocusRequest.MODE_DIRECT: "Direct",
    FocusRequest.MODE_CONDITIONED: "Conditioned",
}


@dataclass(frozen=True)
class Cell:
    """One actuator of the command map.

    Attributes:
        number: 1-based.
        x, y: mm, y up.
        signal: normalised; None = nothing commanded yet.
        fill: colour.
        remarks: flags and grade in words.
        mark: the symbol of the first of them, "" = none.
    """

    number: int
    x: float
    y: float
    signal: float | None
    fill: str
    remarks: tuple[str, ...]
    mark: str

    @property
    def text(self) -> str:
        """What a screen reader says."""
        at = "nothing commanded yet" if self.signal is None else f"signal {self.signal:+.3f}"
        return ", ".join([f"actuator {self.number}", at, *self.remarks])


def luminance(colour: str) -> float:
    """Relative luminance of a colour "#rrggbb", 0 to 1, as WCAG 2 defines it."""
    channels = np.frombuffer(bytes.fromhex(colour[1:7]), dtype=np.uint8) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def ink_on(colour: str) -> str:
    """Black or white, whichever stands out more; the contrast is at least 4.5 to 1 on any colour."""
    # The contrast is (L + 0.05) / 0.05 with black and 1.05 / (L + 0.05) with white.
    return "#000000" if (luminance(colour) + 0.05) ** 2 > 0.05 * 1.05 else "#ffffff"


def cells(mirror: Any, state: Any, calibration: Any) -> list[Cell]:
    """The actuators of a dm_msgs/MirrorInfo with a dm_msgs/ActuatorState and the grades of a Calibration, or None."""
    count = mirror.actuators

    def one_each(values: Sequence[Any], otherwise: Any) -> Sequence[Any]:
        return values if len(values) == count else [otherwise] * count

    applied = one_each(state.applied if state is not None else (), None)
    flags = one_each(bytes(state.flags) if state is not None else b"", 0)
    grades = one_each(calibration.actuator_grade if calibration is not None else (), "good")
    found = []
    for index, (signal, flag, grade) in enumerate(zip(applied, flags, grades, strict=True)):
        fill = "#e4e7eb"
        if signal is not None:
            share = (signal - mirror.signal_min) / (mirror.signal_max - mirror.signal_min)
            fill = to_hex(SIGNAL_COLOURS(share))
        marks = _marks(flag, grade, signal, mirror)
        found.append(
            Cell(
                number=index + 1,
                x=mirror.actuator_x[index] * 1e3,
                y=mirror.actuator_y[index] * 1e3,
                signal=signal,
                fill=fill,
                remarks=tuple(text for _sign, text in marks),
                mark=marks[0][0] if marks else "",
            )
        )
    return found


def _marks(flags: int, grade: str, signal: float | None, mirror: Any) -> list[tuple[str, str]]:
    """(sign, text), the most important first."""
    middle = 0.5 * (mirror.signal_min + mirror.signal_max)
    marks = []
    if flags & ActuatorState.FLAG_REFUSED:
        marks.append(("!", "its value was refused"))
    if flags & ActuatorState.FLAG_UNUSED:
        marks.append(("×", "no channel is wired to it"))
    if flags & ActuatorState.FLAG_AT_LIMIT and signal is not None:
        marks.append(("▲", "at its upper limit") if signal > middle else ("▼", "at its lower limit"))
    if flags & ActuatorState.FLAG_RAMPING:
        marks.append(("…", "on its way"))
    if grade != "good":
        marks.append(("?", f"graded {grade}"))
    return marks


def towards(found: list[Cell], chosen: int, direction: float) -> int:
    """Number of the nearest actuator in a direction (rad from x to y) from `chosen`; itself at the rim."""
    here = found[chosen - 1]

    def cost(cell: Cell) -> float:
        dx, dy = cell.x - here.x, cell.y - here.y
        along = dx * math.cos(direction) + dy * math.sin(direction)
        across = abs(dy * math.cos(direction) - dx * math.sin(direction))
        return along + 2.0 * across if along > 1e-6 and across <= 1.8 * along else math.inf

    best = min(found, key=cost)
    return best.number if math.isfinite(cost(best)) else chosen


@dataclass(frozen=True)
class Bar:
    """One Zernike coefficient.

    Attributes:
        value_nm: measured, or measured minus predicted.
        reach_nm: half-width of its 95 % interval.
        predicted_nm: None = no prediction, or not to be shown.
    """

    name: str
    value_nm: float
    reach_nm: float
    predicted_nm: float | None


def bars(zernike: Any, predicted: Floats | None, as_difference: bool) -> list[Bar]:
    """Coefficients beyond tilt of a dm_msgs/ZernikeCoefficients; empty when their number or values are not valid.

    Args:
        predicted: (K,) m for the moment of the map; None = not known.
        as_difference: show measured minus predicted.
    """
    measured = np.array(zernike.coefficients, dtype=np.float64)
    if measured.shape != (len(NAMES),) or not np.isfinite(measured).all():
        return []
    sigma = np.array(zernike.sigma, dtype=np.float64)
    reach = SIGMAS_95 * sigma if sigma.shape == measured.shape else np.zeros_like(measured)
    shown, marked = measured, predicted
    if as_difference:
        if predicted is None:
            return []
        shown, marked = measured - predicted, None
    return [
        Bar(
            name=f"{SPOKEN[k].replace('secondary', '2nd')} {NAMES[k].split()[0].replace('_', '').replace('^', ',')}",
            value_nm=float(shown[k]) * 1e9,
            reach_nm=float(reach[k]) * 1e9,
            predicted_nm=float(marked[k]) * 1e9 if marked is not None else None,
        )
        for k in range(PISTON_TILT, len(NAMES))
    ]


def reachable(capabilities: Any) -> tuple[float, float] | None:
    """Smallest and largest reachable curvature, 1/m; None when not known."""
    if capabilities is None or not capabilities.calibration_id:
        return None
    low, high = capabilities.curvature_min, capabilities.curvature_max
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None


def prediction_text(state: Any, mirror: Any = None) -> str:
    """A dm_msgs/FocusState's prediction as a sentence; `mirror`: mirror_info, None = not heard."""
    text = (
        f"Predicted residual {state.predicted_rms * 1e9:.1f} nm rms "
        f"(95 %: {state.predicted_rms_lower * 1e9:.1f} to {state.predicted_rms_upper * 1e9:.1f} nm), "
        f"largest coefficient error below {state.predicted_max_zernike_upper * 1e9:.1f} nm"
    )
    if state.predicted_duration > 0:
        text += f", shape reached after {state.predicted_duration:.2f} s"
    text += f". Mode: {MODES.get(state.mode, '?').lower()}."
    if state.saturated:
        text += f" Saturated: {saturation_text(state, mirror)}."
    if not state.history_known:
        text += " The history of the actuators is not known: a degauss would make this better."
    return text


def poke_signals(base: Sequence[float], actuator: int, amplitude: float, low: float, high: float) -> list[float]:
    """`base` (N,) with one actuator (1-based) moved by `amplitude`, in the other direction where the range ends.

    Raises ValueError when there is no such actuator, or both directions lead out of the range.
    """
    if not 1 <= actuator <= len(base):
        raise ValueError(f"actuator = {actuator}: must be 1 to {len(base)}")
    signals = [float(value) for value in base]
    signals[actuator - 1] = moved(signals[actuator - 1], amplitude, low, high)
    return signals


def moved(signal: float, amplitude: float, low: float, high: float) -> float:
    """`signal` moved by `amplitude`, in the other direction where the range ends. Raises ValueError when both fail."""
    if amplitude == 0.0:
        raise ValueError("amplitude = 0: must not be 0, or nothing moves")
    for there in (signal + amplitude, signal - amplitude):
        if low <= there <= high:
            return there
    raise ValueError(f"amplitude = {amplitude:g}: from {signal:+.3f} both ways leave the range {low:+g} to {high:+g}")


def decimal(text: str | None) -> float | None:
    """The number in `text`, with a decimal point or comma; None = not a number."""
    if "_" in (text or ""):  # a mistyped minus, which Python would overlook: 1_0 is 10 to it
        return None
    try:
        value = float(with_point(text or ""))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def number_in(name: str, text: str | None) -> float:
    """The number typed into the field `name`. Raises ValueError with the field and what was typed."""
    if (value := decimal(text)) is None:
        raise ValueError(f"{_typed(name, text)}: must be a number")
    return value


def whole_number_in(name: str, text: str | None, allowed: range) -> int:
    """The whole number typed into the field `name`. Raises ValueError with field, what was typed, and the range."""
    value = decimal(text)
    if value is None or not (value.is_integer() and int(value) in allowed):
        raise ValueError(f"{_typed(name, text)}: must be a whole number, {allowed[0]} to {allowed[-1]}")
    return int(value)


def _typed(name: str, text: str | None) -> str:
    shown = (text or "").strip()
    return f"{name} = {shown}" if shown else name


def evenly(first: float, last: float, number: int) -> list[float]:
    """`number` curvatures from `first` to `last`, 1/m. Raises ValueError when several would be the same."""
    if first == last and number > 1:
        raise ValueError(f"first = last = {first:g} 1/m: must differ, or recipes must be 1")
    return [round(value, 9) for value in np.linspace(first, last, number).tolist()]


def calibration_text(calibration: Any) -> list[str]:
    """Lines that describe a dm_msgs/Calibration and its accuracy; None = no calibration is in use."""
    if calibration is None:
        return ["No calibration is in use."]
    lines = [
        f"{calibration.id}: {QUALITIES.get(calibration.quality, '?')}, {calibration.maps_used} maps.",
        f"Held out: {calibration.held_out_rms * 1e9:.2f} nm rms, largest coefficient error "
        f"{calibration.held_out_max_zernike * 1e9:.2f} nm.",
    ]
    law = calibration.hysteresis
    if law.play_radius:
        lines.append(
            f"Hysteresis: {law.law}; creep {law.creep_rate:.2%} per decade; held-out moves accurate to "
            f"{law.held_out_max_zernike * 1e9:.2f} nm."
        )
    if calibration.revision:
        lines.append(f"Maps that updated it since: {calibration.revision}.")
    return lines
