"""The faceplate: a free-edge elastic circular plate on springs whose bases the piezo stacks move.

Kirchhoff plate theory ([7], sections 10 and 21), solved by the Rayleigh-Ritz method: free edges are natural boundary
conditions, so Zernike polynomials are admissible without modification.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_jacobi

from dm_common.values import parameter, real, reals, switch, whole
from dm_simulation.mirror import zernike
from dm_simulation.mirror.zernike import Array, Term

#: The squares of the distances to both ends, over that of the ends, up to which an actuator counts as on the circle.
CIRCLE_SLACK = 1.05


@dataclass(frozen=True)
class PlateConfig:
    """Geometry and material of the mirror."""

    diameter: float = parameter(real(0.030, 1e-3, 1.0, "m"), "Diameter of the faceplate.")
    thickness: float = parameter(real(2.4e-3, 1e-5, 0.1, "m"), "Thickness of the faceplate.")
    youngs_modulus: float = parameter(real(74.5e9, 1e6, 1e13, "Pa"), "Young's modulus.")
    poisson_ratio: float = parameter(real(0.17, 0.0, 0.49), "Poisson's ratio.")
    spring_stiffness: float = parameter(real(2e7, 1.0, 1e12, "N/m"), "Stiffness of one stack.")
    actuators: int = parameter(
        whole(37, 7, 1000),
        "Actuators of the hexagonal pattern: 1 in the centre, then rings of 6, 12, 18, ..., numbered in angle.",
    )
    pitch: float = parameter(real(4.3e-3, 1e-4, 0.1, "m"), "Distance between neighbouring actuators.")
    start_angle: float = parameter(
        real(0.0, -7.0, 7.0, "rad"), "Angle of actuator 2, and of the first in every other ring, from the x axis."
    )
    clockwise: bool = parameter(switch(False), "Whether actuators are numbered clockwise in their rings.")
    order: int = parameter(whole(36, 12, 60), "Radial order of the Ritz solution.")
    actuator_x: tuple[float, ...] = parameter(
        reals([], -1.0, 1.0, "m"), "Actuator positions, x, in place of the hexagonal pattern."
    )
    actuator_y: tuple[float, ...] = parameter(
        reals([], -1.0, 1.0, "m"), "Actuator positions, y, in place of the hexagonal pattern."
    )


def actuator_positions(
    pitch: float,
    start_angle: float = 0.0,
    clockwise: bool = False,
    actuators: int = 37,
    name: str = "plate.actuators",
) -> tuple[Array, Array]:
    """Positions x, y (N,) in m of the actuators 1..N.

    Raises:
        ValueError: full rings cannot hold that number of actuators; the message names the parameter `name`.
    """
    corners = np.exp(1j * np.pi / 3 * np.arange(7))
    grid = [np.zeros(1, complex)]
    placed = ring = 1
    while placed < actuators:
        side, step = np.divmod(np.arange(6 * ring), ring)
        grid.append(corners[side] * (ring - step) + corners[side + 1] * step)
        placed += 6 * ring
        ring += 1
    if placed != actuators:
        raise ValueError(
            f"{name} = {actuators}: full rings hold 1, 7, 19, 37, 61, ...; a plate takes others by plate.actuator_x, _y"
        )
    points = np.concatenate(grid)
    points = pitch * np.exp(1j * start_angle) * (points.conj() if clockwise else points)
    return points.real.copy(), points.imag.copy()


def neighbour_pairs(x: Array, y: Array) -> NDArray[np.intp]:
    """Pairs (P, 2) of 0-based actuators whose circle, with the line between them as its diameter, holds no other.

    An actuator on the circle, up to rounding, counts as inside, so that a square grid has no diagonals.

    Raises:
        ValueError: two actuators are at the same place.
    """
    apart = np.square(x[:, None] - x) + np.square(y[:, None] - y)
    pairs = []
    for first, near in enumerate(apart):
        far, square = apart[:, first + 1 :], near[first + 1 :]  # of each pair once
        if (square == 0).any():
            second = first + 1 + np.argmin(square)
            raise ValueError(f"plate.actuator_x and _y: actuators {first + 1} and {second + 1} are at the same place")
        less = square * (1 - 1e-9)  # so that everyone keeps the one nearest to it, and equal distances count as equal
        inside = (near[:, None] < less) & (far < less) & (near[:, None] + far <= CIRCLE_SLACK * square)
        pairs += [(first, second) for second in first + 1 + np.flatnonzero(~inside.any(axis=0))]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def bending_energy_matrix(terms: tuple[Term, ...], poisson_ratio: float) -> Array:
    """Matrix K (T, T) with bending energy = D / (2 a^2) c^T K c for the sag sum_j c_j Z_j(x/a, y/a) of a plate.

    D = E h^3 / (12 (1 - nu^2)) is the flexural rigidity, a the plate radius. Curvatures in polar coordinates:
    k_r = f'', k_t = f'/r - m^2 f/r^2, k_rt = m (f/r^2 - f'/r) for a sag f(r) cos(m t); the energy density is
    k_r^2 + k_t^2 + 2 nu k_r k_t + 2 (1 - nu) k_rt^2. With s = r^2 all products are polynomials (times s^(m-2), whole
    powers), so the Gauss-Legendre rule is exact. Different m, and sine and cosine, do not couple.
    """
    order = max(term.n for term in terms)
    nodes, weights = np.polynomial.legendre.leggauss(order + 2)
    s = (nodes + 1) / 2
    r = np.sqrt(s)
    weights = weights / 4  # r dr = ds/2 and ds = dnodes/2
    matrix = np.zeros((len(terms), len(terms)))
    blocks: dict[tuple[int, bool], list[int]] = {}
    for j, term in enumerate(terms):
        blocks.setdefault((term.m, term.sine), []).append(j)
    for (m, _), members in blocks.items():
        angular = 2 * np.pi if m == 0 else np.pi
        curvatures = [_polar_curvatures(terms[j].n, m, s, r) for j in members]
        k_r, k_t, k_rt = (np.array(parts) for parts in zip(*curvatures, strict=True))
        w = weights * angular
        cross = (k_r * w) @ k_t.T
        matrix[np.ix_(members, members)] = (
            (k_r * w) @ k_r.T
            + (k_t * w) @ k_t.T
            + poisson_ratio * (cross + cross.T)
            + 2 * (1 - poisson_ratio) * (k_rt * w) @ k_rt.T
        )
    return matrix


def _polar_curvatures(n: int, m: int, s: Array, r: Array) -> tuple[Array, Array, Array]:
    """k_r, k_t and k_rt (without their angular factors) of one orthonormal term, at radii r = sqrt(s)."""
    k = (n - m) // 2
    argument = 2 * s - 1
    zero = np.zeros_like(s)
    # f = r^m q(s); the derivatives of Jacobi polynomials are Jacobi polynomials.
    q = eval_jacobi(k, 0, m, argument)
    q1 = (k + m + 1) * eval_jacobi(k - 1, 1, m + 1, argument) if k >= 1 else zero
    q2 = (k + m + 1) * (k + m + 2) * eval_jacobi(k - 2, 2, m + 2, argument) if k >= 2 else zero
    low = r ** (m - 2) * q if m >= 2 else zero  # for m < 2 its factors vanish
    k_r = m * (m - 1) * low + (4 * m + 2) * r**m * q1 + 4 * r ** (m + 2) * q2
    k_t = (m - m * m) * low + 2 * r**m * q1
    k_rt = m * ((1 - m) * low - 2 * r**m * q1)
    scale = zernike.norm(n, m)
    return scale * k_r, scale * k_t, scale * k_rt


class Plate:
    """The solved plate.

    Attributes:
        x, y: actuator positions (N,), m.
        terms: Zernike terms over the full plate.
        stiffness: (T, T), N/m: bending energy is c^T stiffness c / 2 for coefficients c in m.
        influence: (T, N): coefficients of the sag per metre of base displacement of each spring.
    """

    def __init__(self, config: PlateConfig | None = None) -> None:
        self.config = config = config or PlateConfig()
        self.radius = config.diameter / 2
        if len(config.actuator_x) != len(config.actuator_y):
            raise ValueError(
                f"plate.actuator_x has {len(config.actuator_x)} values, plate.actuator_y {len(config.actuator_y)}: must"
                " be as many"
            )
        if config.actuator_x:
            self.x, self.y = np.array(config.actuator_x), np.array(config.actuator_y)
        else:
            self.x, self.y = actuator_positions(config.pitch, config.start_angle, config.clockwise, config.actuators)
        if np.hypot(self.x, self.y).max() > self.radius:
            raise ValueError(
                f"plate.pitch = {config.pitch:g} m, or plate.actuator_x and _y: actuators beyond the edge of the plate,"
                f" plate.diameter = {config.diameter:g} m"
            )
        if np.linalg.matrix_rank((self.x - self.x.mean(), self.y - self.y.mean())) < 2:
            raise ValueError(
                f"plate.actuator_x and _y: {len(self.x)} actuators on one line cannot hold the plate: must be three or"
                " more that are not"
            )
        self.terms = zernike.terms_to_order(config.order)
        self.rigidity = config.youngs_modulus * config.thickness**3 / (12 * (1 - config.poisson_ratio**2))
        self.stiffness = self.rigidity / self.radius**2 * bending_energy_matrix(self.terms, config.poisson_ratio)
        at_springs = self.modes(self.x, self.y)
        loads = config.spring_stiffness * at_springs.T
        # Least total energy: bending c^T K c / 2 plus springs k |at_springs c - d|^2 / 2.
        self.influence = np.asarray(np.linalg.solve(self.stiffness + loads @ at_springs, loads), float)

    def modes(self, x: Array, y: Array) -> Array:
        """The Zernike terms at points in m: x.shape + (T,)."""
        return zernike.evaluate(np.asarray(x) / self.radius, np.asarray(y) / self.radius, self.terms)

    def influence_at(self, x: Array, y: Array) -> Array:
        """Sag at points (in m) per unit base displacement of each actuator: x.shape + (N,)."""
        return self.modes(x, y) @ self.influence
