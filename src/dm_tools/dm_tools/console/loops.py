"""Hysteresis loops of one actuator, from the law of the calibration and from maps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dm_common.hysteresis.law_shape import closed_cycle, opening
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_tools.console.view_models import moved

#: Points of each branch of a loop.
STEPS = 41
#: Signals of a measured loop relative to its start, in units of the amplitude: up, back, down, and back.
WAY = (0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0)


@dataclass(frozen=True)
class Loop:
    """A hysteresis loop of one actuator, effective over applied signal.

    Attributes:
        signals, rising, falling: the closed cycle over the whole range by the law: signals, effective signals.
        position: (signal, effective signal) now; None = not known.
        path, modelled_path, measured: signals of a measured loop, effective signals by law and by maps; may be empty.
    """

    actuator: int
    signals: tuple[float, ...]
    rising: tuple[float, ...]
    falling: tuple[float, ...]
    position: tuple[float, float] | None = None
    path: tuple[float, ...] = ()
    modelled_path: tuple[float, ...] = ()
    measured: tuple[float, ...] = ()

    @property
    def text(self) -> str:
        """The loop in a sentence."""
        apart = opening(np.array(self.rising)[:, None], np.array(self.falling)[:, None])[0]
        return f"the branches are up to {apart:.1%} of the span apart"


def modelled_loop(law: HysteresisModel, actuator: int, low: float, high: float) -> Loop:
    """The closed cycle of one actuator (1-based) between `low` and `high` under `law`, without creep."""
    own = actuator - 1 if law.actuators else 0
    signals, rising, falling = closed_cycle(law, low, high, STEPS)
    return Loop(actuator, *(tuple(values.tolist()) for values in (signals, rising[:, own], falling[:, own])))


def way(start: float, amplitude: float, low: float, high: float) -> list[float]:
    """Signals of a measured loop around `start`, inside `low` .. `high`; the loop ends at `start`.

    Raises ValueError when the amplitude leads out of the range in both directions.
    """
    moved(start, amplitude, low, high)
    return [min(max(start + amplitude * share, low), high) for share in WAY]


def modelled_way(law: HysteresisModel, state: HysteresisState, actuator: int, signals: Sequence[float]) -> list[float]:
    """Effective signals of one actuator (1-based) that goes from `state` through `signals`, without further creep."""
    values = []
    for signal in signals:
        shape = state.signals.copy()
        shape[actuator - 1] = signal
        state = law.move(state, shape, state.time)
        values.append(float(law.effective(state)[actuator - 1]))
    return values


def effective_change(before: Any, after: Any, calibration: Any, actuator: int) -> float:
    """Change of the effective signal of one actuator (1-based) between two maps.

    Args:
        before, after: dm_msgs/SurfaceSamples at the points of the calibration.
        calibration: dm_msgs/Calibration.

    Raises:
        ValueError: the maps were sampled at other points, or the actuator does nothing to the surface.
    """
    points, count = len(calibration.sample_x), calibration.actuators
    x, y = np.array(after.x), np.array(after.y)
    if x.shape != (points,) or not np.allclose(x, calibration.sample_x) or not np.allclose(y, calibration.sample_y):
        raise ValueError(f"the map was sampled at {x.size} points, not at the {points} of the calibration")
    change = np.array(after.sag) - np.array(before.sag)
    response = np.array(calibration.influence_sag).reshape(points, count)[:, actuator - 1]
    good = np.isfinite(change)
    root = np.sqrt(np.array(calibration.sample_weight)[good])
    columns = np.column_stack([response, np.ones(points), x, y])[good] * root[:, None]
    if not np.linalg.norm(columns[:, 0]) > 0.0:
        raise ValueError(f"actuator {actuator} does nothing to the surface of this calibration")
    return float(np.linalg.lstsq(columns, change[good] * root, rcond=None)[0][0])
