"""Preisach operators on the plane of switching signals, by their Everett function; densities drawn at random.

A relay switches up where the signal rises to alpha = v + r and down where it falls to beta = v - r. The Everett
function F(alpha, beta) gives how many relays switch on a move from a turning point to a signal: the density integrated
over the triangle between both ([16], section 2.4). An operator remembers only the turning points that no later move has
wiped out.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from dm_simulation.mirror.zernike import Array

#: Density of relays at centres v and half-widths r, per unit of each: (G, G) from (G, G) if common to all actuators,
#: (N, G, G) if each has its own.
Relays = Callable[[Array, Array], Array]
#: Range -EDGE to +EDGE of the tables of Everett functions, and their number of points.
EDGE, POINTS = 1.2, 121


class PreisachOperator:
    """`count` Preisach operators that begin demagnetised at signal 0.

    The Everett function is stored as a table of F / (alpha - beta)^2, which is smooth. Interpolated from it, F vanishes
    on the diagonal, as it must, and small moves have parabolic loops.
    """

    def __init__(self, count: int, relays: Relays) -> None:
        grid = np.linspace(-EDGE, EDGE, POINTS)
        alpha, beta = grid[:, None], grid[None, :]
        density = np.atleast_3d(relays((alpha + beta) / 2, np.abs(alpha - beta) / 2).T).T
        self._row = np.arange(count) if len(density) > 1 else np.zeros(count, int)
        everett, first = _everett(0.5 * density, grid[1] - grid[0])  # d alpha d beta = 2 dv dr
        gap = alpha - beta + np.eye(POINTS)
        diagonal = np.diagonal(density, axis1=1, axis2=2)[:, :, None] * np.eye(POINTS) / 4
        self._table = np.where(gap > 0, everett / gap**2, 0.0) * (1 - np.eye(POINTS)) + diagonal
        # Below the diagonal the table is mirrored, so that interpolation across it sees a smooth function.
        self._table += np.swapaxes(np.tril(self._table, -1), 1, 2)
        self._middle = first
        # Turning points not wiped out yet, the outermost first, and m at each. Before the first real one comes its
        # mirror image, at which the first loop of a demagnetised operator would have begun.
        self._turn = np.zeros((count, 8))
        self._height = np.zeros((count, 8))
        self._depth = np.zeros(count, int)
        self._u, self._m, self._way = np.zeros(count), np.zeros(count), np.zeros(count)

    def move(self, u: Array) -> Array:
        """Go monotonically from the last signals to `u` (N,), clipped to +-EDGE; returns m (N,)."""
        u = np.minimum(np.maximum(u, -EDGE), EDGE)
        way = np.sign(u - self._u)
        moved, rows = way != 0, np.arange(len(u))
        turned = way * self._way < 0
        first = turned & (self._depth == 0)
        if first.any():
            self._push(first, -self._u, self._initial(-self._u))
        if turned.any():
            self._push(turned, self._u, self._m)
        # A move wipes out the turning points of its own direction that it passes, each with the one before it. The
        # last one is passed first.
        last = self._turn[rows, np.maximum(self._depth - 2, 0)]
        if ((self._depth >= 2) & moved & ((last - u) * way <= 0)).any():
            left = self._depth[:, None] - np.arange(self._turn.shape[1])
            passed = (left >= 2) & (left % 2 == 0) & ((self._turn - u[:, None]) * way[:, None] <= 0) & moved[:, None]
            self._depth -= 2 * np.count_nonzero(passed, axis=1)
            self._depth[self._depth == 1] = 0  # only the mirror image is left: demagnetised state again
        branch = np.maximum(self._depth - 1, 0)
        m = self._height[rows, branch] + way * self._switched(u, self._turn[rows, branch])
        if not self._depth.all():
            m = np.where(self._depth == 0, self._initial(u), m)
        self._m = np.where(moved, m, self._m)
        self._way = np.where(moved, way, self._way)
        self._u = u
        return self._m

    def _push(self, which: NDArray[np.bool_], turn: Array, height: Array) -> None:
        if self._depth.max() == self._turn.shape[1]:
            self._turn = np.pad(self._turn, ((0, 0), (0, len(self._turn[0]))))
            self._height = np.pad(self._height, ((0, 0), (0, len(self._height[0]))))
        (rows,) = np.nonzero(which)
        self._turn[rows, self._depth[rows]] = turn[rows]
        self._height[rows, self._depth[rows]] = height[rows]
        self._depth[rows] += 1

    def _switched(self, one: Array, other: Array) -> Array:
        """The Everett function for moves between two signals (N,)."""
        high, low = np.maximum(one, other), np.minimum(one, other)
        (i, x), (j, y) = _place(high), _place(low)
        at, table = (self._row * POINTS + i) * POINTS + j, self._table.ravel()
        below = (1 - y) * table[at] + y * table[at + 1]
        above = (1 - y) * table[at + POINTS] + y * table[at + POINTS + 1]
        return (high - low) ** 2 * ((1 - x) * below + x * above)

    def _initial(self, u: Array) -> Array:
        """m on the initial curve from the demagnetised state, where relays with alpha + beta < 0 are up."""
        i, x = _place(np.abs(u))
        middle = (1 - x) * self._middle[self._row, i] + x * self._middle[self._row, i + 1]
        return middle + np.sign(u) / 2 * self._switched(np.abs(u), -np.abs(u))


def _place(u: Array) -> tuple[Array, Array]:
    """Index of the table point below each signal, and the distance from it as a share of the spacing."""
    at = (u + EDGE) * ((POINTS - 1) / (2 * EDGE))
    i = np.minimum(at.astype(int), POINTS - 2)
    return i, at - i


def _everett(density: Array, step: float) -> tuple[Array, Array]:
    """Integrals of densities (M, G, G) over triangles.

    Returns:
        (M, G, G) from beta to alpha, and (M, G) mean of m at +u and at -u on the initial curve, demagnetised at 0.
    """

    def cumulated(values: Array, axis: int) -> Array:
        return np.asarray(cumulative_trapezoid(values, dx=step, axis=axis, initial=0))

    def on_diagonal(values: Array) -> Array:
        return np.diagonal(values, axis1=1, axis2=2)

    across = cumulated(density, 2)
    rows = on_diagonal(across)[:, :, None] - across  # over beta, up to the diagonal
    everett = cumulated(rows, 1)
    everett = everett - on_diagonal(everett)[:, None, :]
    # Rising from 0, relays with alpha in 0..u and beta > -alpha switch; falling, with beta in u..0 and alpha < -beta.
    along = cumulated(density, 1)
    rising = np.diagonal(rows[:, :, ::-1], axis1=1, axis2=2)
    falling = np.diagonal(along[:, ::-1, :], axis1=1, axis2=2) - on_diagonal(along)
    up, down = cumulated(rising, 1), cumulated(falling, 1)
    zero = density.shape[1] // 2
    up, down = up - up[:, zero, None], down[:, zero, None] - down
    return everett, (up - down[:, ::-1]) / 2


def drawn_density(count: int, rng: np.random.Generator, spread: float = 0.15) -> Relays:
    """A random density of no simple form for a mirror, and for each of `count` actuators one that differs by `spread`.

    The mirror's is one of three distributions over half-widths and centres, or over both switching signals, with bumps;
    each actuator's is that times the exponential of a smooth random field, a sum of bumps of heights `spread`.
    """
    kind = rng.integers(3)
    decay, skew, bend = rng.uniform(0.15, 0.45), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)
    coercive, width, peak = rng.uniform(0.1, 0.3), rng.uniform(0.5, 1.0), rng.uniform(0.3, 0.8)
    bumps = rng.uniform((0.0, -1.0, 0.1, 0.2), (1.0, 1.0, 0.5, 0.8), (10, 4))
    shared, own = rng.standard_normal(3), spread * rng.standard_normal((count, len(bumps)))

    def density(v: Array, r: Array) -> Array:
        if kind == 0:
            common = np.exp(-r / decay)
        elif kind == 1:
            common = np.exp(-np.square(np.log((r + 0.02) / coercive) / width) / 2)
        else:
            common = 1 / ((1 + ((v + r - coercive) / peak) ** 2) * (1 + ((v - r + coercive) / peak) ** 2))
        fields = np.array(
            [np.exp(-(((r - at_r) / wide_r) ** 2) - ((v - at_v) / wide_v) ** 2) for at_r, at_v, wide_r, wide_v in bumps]
        )
        uneven = np.maximum(np.tensordot(shared, fields[: len(shared)], 1), -0.2) * np.exp(-r / 0.5)
        common = np.maximum(common * (1 + skew * v + bend * v * v) + 0.5 * uneven, 0.0)
        return np.asarray(common * np.exp(np.tensordot(own, fields, 1)))

    return density
