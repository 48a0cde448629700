"""Geometry and limits of a mirror, and whether a calibration belongs to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.distance import cdist

Floats = NDArray[np.float64]

#: Actuators closer than this many pitches are neighbours.
NEIGHBOUR_REACH = 1.25
#: Relative difference between the aperture radius of a calibration and the mirror's up to which it belongs to it.
APERTURE_TOLERANCE = 0.02


@dataclass(frozen=True)
class Mirror:
    """One mirror as the driver describes it.

    Attributes:
        name, serial: model and serial number.
        x, y: (N,) actuator positions in the mirror surface frame, m (x right, y up).
        working_radius: radius of the calibrated aperture, m.
        signal_min, signal_max: range of the normalised signals.
        neighbours: (E, 2) 0-based pairs of neighbouring actuators.
        neighbour_difference_max: largest allowed |difference| between neighbours, normalised.
    """

    name: str
    serial: str
    x: Floats
    y: Floats
    working_radius: float
    signal_min: float = -1.0
    signal_max: float = 1.0
    neighbours: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    neighbour_difference_max: float = 2.0

    def __post_init__(self) -> None:
        if self.x.ndim != 1 or self.x.shape != self.y.shape or self.x.size == 0:
            raise ValueError(f"actuator_x has {self.x.size} values and actuator_y {self.y.size}: must be equal, not 0")
        if not (np.isfinite(self.x).all() and np.isfinite(self.y).all()):
            raise ValueError("actuator_x and actuator_y must be finite")
        if not self.working_radius > 0:
            raise ValueError(f"working_radius = {self.working_radius}: must be positive, m")
        if not self.signal_min < self.signal_max:
            raise ValueError(f"signal_min = {self.signal_min}: must be below signal_max = {self.signal_max}")
        if self.neighbours.size and not (self.neighbours.min() >= 0 and self.neighbours.max() < self.actuators):
            raise ValueError(f"neighbours: indices must lie in 0..{self.actuators - 1}")

    @property
    def actuators(self) -> int:
        """Number of actuators N."""
        return int(self.x.size)

    @property
    def rest(self) -> Floats:
        """(N,) the mid-range signals that reference frames are taken at."""
        return np.full(self.actuators, 0.5 * (self.signal_min + self.signal_max))

    @property
    def rings(self) -> NDArray[np.int64]:
        """(N,) ring of each actuator: see :func:`rings`."""
        return rings(self.x, self.y)

    def breaks_limits(self, signals: Floats, tolerance: float = 1e-9) -> bool:
        """Whether `signals` leave the range or the neighbour limit."""
        return scale_to_limits(signals, self)[1] < 1.0 - tolerance


def mismatch(
    mirror: Mirror, serial: str, actuators: int, aperture_radius: float, tolerance: float = APERTURE_TOLERANCE
) -> str:
    """Why a calibration does not belong to `mirror`, as a sentence; "" = it does.

    Args:
        mirror: as the driver describes it.
        serial, actuators, aperture_radius: of the mirror that was calibrated, the last in m.
        tolerance: largest relative difference of the two aperture radii.
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


def pitch(x: Floats, y: Floats) -> float:
    """Smallest distance between two actuators, in the unit of the positions."""
    points = np.column_stack((x, y))
    distance = cdist(points, points)
    np.fill_diagonal(distance, np.inf)
    return float(distance.min())


def rings(x: Floats, y: Floats) -> NDArray[np.int64]:
    """Ring of each actuator: steps from neighbour to neighbour from the actuator nearest to the centroid (ring 0).

    Actuators that no chain of neighbours reaches get -1.
    """
    if x.size == 1:
        return np.zeros(1, dtype=np.int64)
    points = np.column_stack((x, y))
    near = cdist(points, points) < NEIGHBOUR_REACH * pitch(x, y)
    centre = int(np.argmin(np.hypot(x - x.mean(), y - y.mean())))
    steps = shortest_path(csr_array(near.astype(float)), unweighted=True, indices=centre)
    return np.where(np.isfinite(steps), steps, -1).astype(np.int64)


def scale_to_limits(signals: Floats, mirror: Mirror) -> tuple[Floats, float]:
    """Scale `signals` (N,) about their mean until range and neighbour limit hold.

    A common signal lifts the plate without bending it, so scaling about the mean keeps the shape and changes its size.

    Returns:
        The signals to use and the factor, 1 when nothing had to change.
    """
    mean = float(np.clip(signals.mean(), mirror.signal_min, mirror.signal_max))
    departure = signals - signals.mean()
    factor = 1.0
    if departure.max(initial=0.0) > mirror.signal_max - mean:
        factor = min(factor, (mirror.signal_max - mean) / departure.max())
    if -departure.min(initial=0.0) > mean - mirror.signal_min:
        factor = min(factor, (mean - mirror.signal_min) / -departure.min())
    if mirror.neighbours.size:
        difference = np.abs(np.diff(signals[mirror.neighbours], axis=1)).max()
        if difference > mirror.neighbour_difference_max:
            factor = min(factor, mirror.neighbour_difference_max / difference)
    if factor == 1.0:
        return np.clip(signals, mirror.signal_min, mirror.signal_max), 1.0
    # Rounding must not leave a value a hair above a limit that the driver checks exactly.
    return np.clip(mean + factor * (1.0 - 1e-12) * departure, mirror.signal_min, mirror.signal_max), factor
