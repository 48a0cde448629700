"""A membrane attracted by electrodes behind it: a mirror by another principle than piezo stacks.

The membrane is under tension T and clamped at its edge, so its deflection follows the Poisson equation
``T div grad w = -p`` with w = 0 there ([30]). Electrodes act on it with ``p = epsilon V^2 / (2 g^2)``, g the present
gap: they only pull, the more strongly the closer the membrane has come. Where it has come closer by a third of the gap
it would fall onto them, so mirrors that full volts bring there are refused.
There is neither hysteresis nor creep; the zero drifts slowly after the start, as in a mount that warms up.

With rho = r / a, the polynomials ``(1 - rho^2) rho^m P_k^(1,m)(2 rho^2 - 1)`` times cos or sin of m theta vanish at the
edge, and the Laplacian multiplies what follows the first bracket by ``-4 (k + 1)(k + m + 1)``, so in this basis the
solution is explicit: P are Jacobi polynomials, orthogonal over the disc with the weight 1 - rho^2.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import eval_jacobi

from dm_common.values import parameter, real, whole
from dm_simulation.mirror import zernike
from dm_simulation.mirror.plate import actuator_positions
from dm_simulation.mirror.zernike import Array

#: Permittivity of free space, A s / (V m).
EPSILON = 8.8541878128e-12
#: Quadrature points over an electrode, along its radius and around it: accurate to 1e-9 of its load.
_RADII, _ANGLES = 6, 16
#: Deflection, as a share of the gap, beyond which the pull grows faster than the restoring force of the tension.
NEAREST = 1 / 3
#: Most iterations of gap and pressure, and the change of the deflection, as a share of the gap, that ends them.
_ROUNDS, _SETTLED = 100, 1e-9


@dataclass(frozen=True)
class MembraneConfig:
    """Geometry and state of the mirror."""

    diameter: float = parameter(real(0.015, 1e-3, 1.0, "m"), "Diameter inside the frame.")
    tension: float = parameter(real(60.0, 1e-3, 1e5, "N/m"), "Tension of the membrane.")
    gap: float = parameter(real(100e-6, 1e-6, 1e-2, "m"), "Distance from the electrodes to the flat membrane.")
    actuators: int = parameter(
        whole(37, 7, 1000), "Electrodes of the hexagonal pattern: full rings, numbered like the stacks."
    )
    pitch: float = parameter(real(1.8e-3, 1e-4, 0.1, "m"), "Distance between neighbouring electrodes.")
    electrode_diameter: float = parameter(real(1.7e-3, 1e-4, 0.1, "m"), "Diameter of an electrode.")
    gain_spread: float = parameter(real(0.03, 0.0, 0.3), "Standard deviation of relative pulls, cut off at 3 sigma.")
    drift: float = parameter(real(0.0, 0.0, 1e-5, "m"), "Deflection by which the zero drifts in a long time.")
    drift_time: float = parameter(real(3600.0, 1.0, 1e7, "s"), "Time in which 63 % of that drift happens.")
    order: int = parameter(whole(36, 12, 60), "Degree of the polynomials of the solution.")


class Membrane:
    """The solved membrane and its electrodes. Time is passed in (s, any origin) and never read from a clock.

    Args:
        config: geometry.
        rng: draws the pull of the electrodes and the pattern of the drift.
        time: s, at which the drift of the zero begins.
        volts_max: full volts.

    Attributes:
        x, y: positions of the electrodes (N,), m.
        radius: m.

    Raises:
        ValueError: electrodes do not form full rings or extend beyond the membrane, or full volts pull it onto them.
    """

    def __init__(
        self, config: MembraneConfig, rng: np.random.Generator, time: float = 0.0, volts_max: float = 0.0
    ) -> None:
        self.config = config
        self.radius = config.diameter / 2
        self.x, self.y = actuator_positions(config.pitch, actuators=config.actuators, name="membrane.actuators")
        if np.hypot(self.x, self.y).max() + config.electrode_diameter / 2 > self.radius:
            raise ValueError(
                f"membrane.pitch = {config.pitch:g} m: electrodes beyond the edge of the membrane,"
                f" membrane.diameter = {config.diameter:g} m"
            )
        terms = zernike.terms_to_order(config.order - 2)
        self._n, self._m, self._sine = (np.array(column) for column in zip(*terms, strict=True))
        self._k = (self._n - self._m) // 2
        #: (T, N): coefficients of the deflection in m per Pa on each electrode.
        self._compliance = self._solve()
        self._at_electrodes = -self.influence_at(self.x, self.y)
        count = config.actuators
        self._gain = 1 + config.gain_spread * np.clip(rng.standard_normal(count), -3, 3)
        pattern = 1 + 0.5 * rng.standard_normal(count)
        self._drift = config.drift / np.abs(self._at_electrodes @ pattern).max() * pattern
        self._began = self._time = time
        if self._pulled(np.full(count, volts_max))[1] >= NEAREST:
            raise ValueError(
                f"membrane.tension = {config.tension:g} N/m: must be larger, since {volts_max:g} V pull the membrane "
                f"onto its electrodes (membrane.gap = {config.gap:g} m)"
            )
        self.apply(np.zeros(count), time)

    def _modes(self, x: Array, y: Array) -> Array:
        """The polynomials at points in m: x.shape + (T,)."""
        rotor = (np.asarray(x) + 1j * np.asarray(y))[..., None] / self.radius
        square = np.abs(rotor) ** 2
        angular = rotor**self._m
        radial = (1 - square) * eval_jacobi(self._k, 1, self._m, 2 * square - 1)
        return np.asarray(radial * np.where(self._sine, angular.imag, angular.real))

    def _solve(self) -> Array:
        nodes, weights = np.polynomial.legendre.leggauss(_RADII)
        r = self.config.electrode_diameter / 2 * np.sqrt((nodes + 1) / 2)
        angle = np.arange(_ANGLES) * 2 * np.pi / _ANGLES
        x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
        mean = np.repeat(weights / 2, _ANGLES) / _ANGLES
        loads = np.tensordot(mean, self._modes(self.x + x[:, None], self.y + y[:, None]), 1).T
        loads *= np.pi * (self.config.electrode_diameter / 2 / self.radius) ** 2
        # Load divided by the norm of the polynomial and by the factor of the Laplacian.
        around = np.where(self._m == 0, 2, 1) * np.pi
        factor = self.radius**2 / (2 * self.config.tension) * (self._n + 2) / (around * (self._k + 1) ** 2)
        return np.asarray(factor[:, None] * loads)

    def influence_at(self, x: Array, y: Array) -> Array:
        """Sag at points (in m) per Pa on each electrode: x.shape + (N,). The pull from behind makes it concave."""
        return -self._modes(x, y) @ self._compliance

    def advance(self, time: float) -> None:
        """Let the zero drift until `time`. A clock that jumps back only moves the origin of time."""
        self._began += min(time - self._time, 0.0)
        self._time = time

    def apply(self, volts: Array, time: float) -> None:
        """Take new volts (N,) at `time`."""
        self.advance(time)
        self._pressure = self._pulled(volts)[0]

    def _pulled(self, volts: Array) -> tuple[Array, float]:
        """Pressures (N,), Pa, and the largest deflection at an electrode as a share of the gap, at most NEAREST."""
        gap = self.config.gap
        pull = self._gain * EPSILON / 2 * (volts / gap) ** 2
        nearer = np.zeros(len(pull))  # grows with each iteration
        for _ in range(_ROUNDS):
            pressure = pull / (1 - nearer) ** 2
            before, nearer = nearer, np.minimum(self._at_electrodes @ pressure / gap, NEAREST)
            if np.abs(nearer - before).max() < _SETTLED:
                break
        return pressure, float(nearer.max())

    @property
    def displacement(self) -> Array:
        """Pressures on the electrodes (N,), Pa, at the time last given; includes the drift of the zero as pressure."""
        return self._pressure - self._drift * np.expm1((self._began - self._time) / self.config.drift_time)
