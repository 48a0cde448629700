"""Geometry, limits and numbers of the actuators of a mirror, reports of its driver, which calibration belongs to it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dm_common import Floats, Ints
from dm_common.errors import size_text
from dm_common.limits import Limits

#: Largest relative difference between the aperture radii of a calibration and of the mirror that it belongs to.
APERTURE_TOLERANCE = 0.02
#: Largest coordinate of an actuator, m; a larger one must be in another unit.
FARTHEST_M = 1.0


@dataclass(frozen=True)
class Mirror:
    """One mirror as the driver describes it.

    Attributes:
        name, serial: model and serial number.
        x, y: (N,) actuator positions in the mirror surface frame, m (x right, y up).
        working_radius: radius of the calibrated aperture, m.
        limits: of the signals.
    """

    name: str
    serial: str
    x: Floats
    y: Floats
    working_radius: float
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        if not isinstance(self.serial, str):
            raise ValueError(f"serial = {self.serial!r}: must be text")
        for name in ("x", "y"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if self.x.ndim != 1 or self.x.shape != self.y.shape or self.x.size == 0:
            raise ValueError(f"{size_text('actuator_x', self.x.size)}, actuator_y {self.y.size}: must be equal, not 0")
        if not (np.isfinite(self.x).all() and np.isfinite(self.y).all()):
            raise ValueError("actuator_x and actuator_y must be finite")
        if (farthest := float(max(np.abs(self.x).max(), np.abs(self.y).max()))) > FARTHEST_M:
            raise ValueError(f"actuator_x and actuator_y reach {farthest:g}: must be m, within {FARTHEST_M:g}")
        if not self.working_radius > 0:
            raise ValueError(f"working_radius = {self.working_radius}: must be positive, m")
        pairs = self.limits.pairs
        if pairs.size and not (pairs.min() >= 0 and pairs.max() < self.actuators):
            raise ValueError(f"neighbours: indices must lie in 0..{self.actuators - 1}")

    @property
    def actuators(self) -> int:
        """Number of actuators N."""
        return int(self.x.size)

    @property
    def rest(self) -> Floats:
        """(N,) the mid-range signals that reference frames are taken at."""
        return np.full(self.actuators, self.limits.middle)

    @property
    def rings(self) -> Ints:
        """(N,) ring of each actuator: see :func:`~dm_common.geometry.rings`."""
        from dm_common.geometry import rings  # only calibrations ask

        return rings(self.x, self.y)


def mismatch(
    mirror: Mirror, serial: str, actuators: int, aperture_radius: float, tolerance: float = APERTURE_TOLERANCE
) -> str:
    """Why a calibration does not belong to `mirror`, as a sentence; "" = it does.

    `serial`, `actuators` and `aperture_radius` (m) are those of the mirror that was calibrated; `tolerance` is the
    largest relative difference of the two aperture radii.
    """
    if serial != mirror.serial:
        return f"measured on mirror serial {serial!r}, this is {mirror.serial!r}"
    if actuators != mirror.actuators:
        return f"has {actuators} actuators, this mirror {mirror.actuators}"
    if not abs(aperture_radius - mirror.working_radius) <= tolerance * mirror.working_radius:
        return (
            f"aperture radius {aperture_radius * 1e3:.3f} mm, this mirror's working aperture "
            f"{mirror.working_radius * 1e3:.3f} mm +-{tolerance:.1%}"
        )
    return ""


def actuators_text(numbers: Iterable[object], text: str = "") -> str:
    """Actuators by their `numbers`, from 1, and the `text` on them; "" = there are none.

    The text begins with its verb in singular and plural: "is/are dead" makes "actuator 5 is dead" and "actuators 5, 7
    are dead".
    """
    listed = [str(number) for number in numbers]
    if not listed:
        return ""
    first, _, rest = text.partition(" ")
    verbs = first.split("/")
    noun, verb = ("actuator", verbs[0]) if len(listed) == 1 else ("actuators", verbs[-1])
    return " ".join(filter(None, (noun, ", ".join(listed), verb, rest)))


@dataclass(frozen=True, eq=False)
class Applied:
    """A report of the driver; fields as in dm_msgs/ActuatorState.

    Attributes:
        time: s, stamp of the last write.
        signals: (N,) applied.
        turns, turned_at: number of turns since activation, and (N,) signals at the last one; None = there was none.
        degausses: number of full-range degausses since activation.
        history_known: no write was lost since the last degauss.
        moving: on the way to another shape.
        requested: (N,) the shape it moves to; None = not known.
        active: the driver is active, so the electronics follow commands.
        linked: the electronics are reachable.
        heard: s, when the driver last sent this; a repeated report confirms that the shape is still held.
        sequence: number of writes since activation.
    """

    time: float
    signals: Floats
    turns: int
    turned_at: Floats | None
    degausses: int
    history_known: bool
    moving: bool = False
    requested: Floats | None = None
    active: bool = True
    linked: bool = True
    heard: float = -np.inf
    sequence: int = 0


def counts_anew(report: Any, last: Any) -> bool:
    """Whether the driver was activated anew between the reports `last` and `report`, Applied or dm_msgs/ActuatorState.

    Any of its counts shows it: a report may come only after the others have passed their values of before.
    """
    return any(getattr(report, name) < getattr(last, name) for name in ("sequence", "turns", "degausses"))
