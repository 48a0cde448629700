"""A mirror with an exactly known linear response, for tests of the calibration.

Each actuator raises the deflection of an infinite plate on an elastic foundation under a point load, -kei(r/l)
([7], section 57): a broad bump with a shallow ditch around it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import kei

from dm_common import Floats
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_common.limits import Limits
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.optics.sampling import SamplePoints, edge_clustered_points
from dm_common.optics.zernike import basis

PITCH = 4.3e-3
RADIUS = 11e-3


def hexagon(rings: int = 3, pitch: float = PITCH, start_deg: float = 0.0) -> tuple[Floats, Floats]:
    """Positions (m) of a hexagonal layout numbered ring by ring, counter-clockwise from `start_deg`."""
    return hexagonal_positions(1 + 3 * rings * (rings + 1), pitch, np.radians(start_deg))


def make_mirror(rings: int = 3, neighbour_difference_max: float = 2.0, serial: str = "T-1") -> Mirror:
    x, y = hexagon(rings)
    return Mirror(
        "PDM30-37",
        serial,
        x,
        y,
        RADIUS,
        Limits(pairs=neighbour_pairs(x, y), neighbour_difference=neighbour_difference_max),
    )


@dataclass
class LinearMirror:
    """Sag z = figure + stroke * bumps * s, with the noise and the ignorance of an interferometer."""

    x: Floats
    y: Floats
    stroke: float = 4e-6
    length: float = 2.6e-3
    noise: float = 0.0
    piston_tilt: float = 0.0
    seed: int = 1
    gains: Floats = field(default_factory=lambda: np.ones(1))
    points: SamplePoints = field(default_factory=lambda: edge_clustered_points(300))

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)
        self.influence = self.bumps(self.x, self.y) * self.gains
        self.modes = basis(self.points.x, self.points.y)
        self.figure_coefficients = np.zeros(21)
        self.figure_coefficients[3:10] = 1e-9 * np.array([20.0, -15.0, 8.0, 12.0, -6.0, 4.0, 9.0])

    def bumps(self, x: Floats, y: Floats) -> Floats:
        """(P, N) sag per unit signal of actuators at x, y (m)."""
        places = np.column_stack((self.points.x, self.points.y)) * RADIUS
        distance = cdist(places, np.column_stack((x, y))) / self.length
        return np.asarray(
            self.stroke * np.where(distance > 0, -kei(np.maximum(distance, 1e-9)), np.pi / 4) / (np.pi / 4)
        )

    def fit_terms(self, sag: Floats) -> Floats:
        """(..., P) sag to (..., 21) coefficients, weighted."""
        weighted = self.modes * self.points.weight[:, None]
        return np.asarray(np.linalg.solve(weighted.T @ self.modes, (sag @ weighted).T).T)

    def sag(self, signals: Floats, drift: float = 0.0) -> Floats:
        """(P,) one noisy reading; `drift` scales the figure."""
        z = self.modes @ ((1.0 + drift) * self.figure_coefficients) + self.influence @ signals
        z = z + self.noise * self.random.standard_normal(z.size)
        return np.asarray(z + self.modes[:, :3] @ (self.piston_tilt * self.random.standard_normal(3)))

    def measurement(self, sag: Floats, stamp_ns: int, **fields: Any) -> Measurement:
        """The map of `sag` (P,) in m, taken at `stamp_ns`; `fields` of it that are not as usual."""
        usual: dict[str, Any] = {
            "sigma": np.full(21, 1e-10),
            "residual_rms": 2e-9,
            "valid_fraction": 0.98,
            "radius": RADIUS,
            "wavelength": 632.8e-9,
        }
        return Measurement(
            points=self.points, sag=sag, coefficients=self.fit_terms(sag), stamp_ns=stamp_ns, **{**usual, **fields}
        )
