"""The 69 sample surfaces of Table 1 in [1], by name.

p01-p54 prescribe signals and are exact. p55-p58 (spheres) and pz01-pz11 (Zernike terms) prescribe a shape; their
signals come from an influence function by bounded least squares, and the surface contains the shape aimed at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.errors import unknown_name
from dm_common.limits import Limits
from dm_common.mirror import Mirror
from dm_common.optics.conic import conic_coefficients
from dm_common.optics.piston_tilt import remove_piston_tilt, rms
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis

#: Channels 1..37 have a surface of their own in Table 1.
TABLE_CHANNELS = 37
#: Radius of curvature of the spheres, m; positive = concave.
SPHERES = {"p55": 60.0, "p56": -60.0, "p57": 100.0, "p58": -100.0}
#: Places in the 21 terms of Z_1^1, Z_2^0, Z_2^2, Z_3^1 to Z_5^5: all but piston and the sine terms.
ZERNIKE_INDEX = tuple(index for index, term in enumerate(TERMS) if term.n and term.kind != "sin")
ZERNIKE_NAMES = tuple(TERMS[index].name.removesuffix(" cos") for index in ZERNIKE_INDEX)
#: Amplitude of the Zernike surfaces as a share of the largest one the limits allow.
ZERNIKE_SHARE = 0.5
#: Damping of the signals towards mid range, relative to the largest singular value of the influence function: so noise
#: does not drive actuators that the aperture hardly shows; the residual of a shape grows by less than 1 %.
DAMPING = 1e-2

_LEVELS = {"p01": -1.0, "p02": -0.5, "p03": 0.0, "p04": 0.5, "p05": 1.0}
_POKES = {f"p{6 + k:02d}": k for k in range(TABLE_CHANNELS)}
_RINGS = {"p43": 1, "p44": 2, "p45": 3}
_CENTRE = {f"p{46 + k}": round(-0.8 + 0.2 * k, 1) for k in range(9)}
_ZERNIKES = {f"pz{k + 1:02d}": k for k in range(len(ZERNIKE_NAMES))}

MODEL_NAMES = (*SPHERES, *_ZERNIKES)
#: All names of Table 1, in its order.
TABLE_1 = (*_LEVELS, *_POKES, *_RINGS, *_CENTRE, *MODEL_NAMES)


class LinearModel(Protocol):
    """A model from which the signals of a shape are solved, such as `dm_calibration.influence.fit.InfluenceFit`."""

    @property
    def influence_sag(self) -> Floats: ...
    @property
    def sag_offset(self) -> Floats: ...
    @property
    def points(self) -> SamplePoints: ...


@dataclass(frozen=True)
class Surface:
    """A sample surface ready to be commanded.

    Attributes:
        signals: (N,) normalised, inside the mirror's limits.
        nominal: (21,) Zernike coefficients of the shape aimed at, m; None when signals were prescribed.
        remark: changes due to the mirror's limits; "" = none.
        target: the shape aimed at, and the residual that the mirror cannot avoid; "" when signals were prescribed.
    """

    signals: Floats
    nominal: Floats | None = None
    remark: str = ""
    target: str = ""


def check_names(names: Sequence[str]) -> tuple[str, ...]:
    """`names` in the order of Table 1, without repetition; all of Table 1 when empty.

    Raises:
        UnknownNameError: naming the near ones.
    """
    for name in names:
        if name not in TABLE_1:
            raise unknown_name("surface", name, TABLE_1)
    return tuple(name for name in TABLE_1 if name in names) if names else TABLE_1


def missing_on(name: str, mirror: Mirror) -> str:
    """Why a surface of Table 1 is not possible on `mirror`; "" = it is."""
    if name in _POKES and _POKES[name] >= mirror.actuators:
        return f"{name} moves actuator {_POKES[name] + 1}; the mirror has {mirror.actuators}"
    if name in _RINGS and not (mirror.rings == _RINGS[name]).any():
        return f"{name} moves circle {_RINGS[name] + 1} of actuators; the mirror has {mirror.rings.max() + 1}"
    return ""


def signal_surface(name: str, mirror: Mirror) -> Surface:
    """A surface with prescribed signals (p01-p54), scaled about its mean when it breaks a limit of the mirror.

    Table 1's -1 and +1 are the ends of the signal range. The mirror must have the actuators, see :func:`missing_on`.
    """
    table = np.full(mirror.actuators, -1.0)
    if name in _LEVELS:
        table[:] = _LEVELS[name]
    elif name in _POKES:
        table[_POKES[name]] = 1.0
    elif name in _RINGS:
        table[mirror.rings == _RINGS[name]] = 1.0
    else:
        table[0] = _CENTRE[name]
    middle, half = mirror.rest[0], mirror.limits.half_range
    signals, factor = mirror.limits.scaled(middle + half * table)
    remark = "" if factor == 1.0 else f"{name}: scaled about its mean to {factor:.0%} to keep the mirror's limits"
    return Surface(signals, remark=remark)


def solve_shape(
    target: Floats, model: LinearModel, mirror: Mirror, limits: Limits | None = None
) -> tuple[Floats, float]:
    """Signals inside the range for the sag `target` (P,), m, by bounded least squares; piston and tilt are free.

    Args:
        limits: to keep; None = the range alone (the caller then scales the shape to keep the limit between neighbours).

    Returns:
        Signals (N,) and the rms sag that is left, m.
    """
    matrix, damping = _damped(model)
    wanted = remove_piston_tilt((target - model.sag_offset)[None, :], model.points)[0]
    programme = BoundedProgramme(matrix, limits or Limits(mirror.limits.low, mirror.limits.high))
    signals = programme.solve(np.concatenate((np.sqrt(model.points.weight) * wanted, damping * mirror.rest)))
    left = wanted - remove_piston_tilt((model.influence_sag @ signals)[None, :], model.points)[0]
    return signals, float(rms(left, model.points.weight))


def largest_step(start: Floats, direction: Floats, mirror: Mirror) -> float:
    """Largest t >= 0 for which start + t direction keeps the range and the neighbour limit; 0 when start breaks one."""
    limits, (a, b) = mirror.limits, mirror.limits.pairs.T
    value = np.append(start - limits.middle, start[a] - start[b])
    slope = np.append(direction, direction[a] - direction[b])
    most = np.append(np.full(start.size, limits.half_range), np.full(a.size, limits.neighbour_difference))
    moving = np.abs(slope) > 1e-12
    steps = (most - np.sign(slope) * value)[moving] / np.abs(slope[moving])
    return max(0.0, float(steps.min())) if steps.size else 0.0


def model_surface(name: str, model: LinearModel, mirror: Mirror) -> Surface:
    """A sphere (p55-p58) or Zernike surface (pz01-pz11), solved on an influence function.

    A Zernike surface gets the amplitude ZERNIKE_SHARE x the largest that the limits allow on top of the flattened
    figure. Both kinds aim at the absolute shape: the initial figure is corrected as far as the actuators can.
    """
    points = model.points
    if name in SPHERES:
        nominal = conic_coefficients(1.0 / SPHERES[name], 0.0, mirror.working_radius)
        wanted = f"sphere of radius {SPHERES[name]:+g} m"
    else:
        index = ZERNIKE_INDEX[_ZERNIKES[name]]
        unit = np.zeros(len(TERMS))
        unit[index] = 1.0
        tilt = index < PISTON_TILT
        flat, _ = solve_shape(np.zeros(points.x.size), model, mirror)
        # Tilt: signals in proportion to x, since maps do not show it. Others: solved without limits, then scaled.
        plane = mirror.x / (np.abs(mirror.x).max() or 1.0)
        direction = plane if tilt else _unbounded(basis(points.x, points.y) @ unit, model)
        amplitude = ZERNIKE_SHARE * largest_step(flat, direction, mirror)
        if tilt:  # its coefficient is not known in metres; as tilt is removed from the maps, 0 is nominal
            signals, _ = mirror.limits.scaled(flat + amplitude * direction)
            target = f"{name}: Z_1^1 as a plane of signals of +-{amplitude:.2f}; its size in metres is not measured"
            return Surface(signals, 0.0 * unit, target=target)
        nominal = amplitude * unit
        wanted = f"{ZERNIKE_NAMES[_ZERNIKES[name]]} of {amplitude * 1e9:.0f} nm"
    signals, left = solve_shape(basis(points.x, points.y) @ nominal, model, mirror)
    signals, factor = mirror.limits.scaled(signals)
    described = f"{name}: {wanted}, {left * 1e9:.1f} nm rms beyond the mirror's reach"
    remark = ""
    if factor < 1.0:
        nominal = factor * nominal
        remark = f"{name}: reduced to {factor:.0%} of the {wanted} to keep the limit between neighbours"
    return Surface(signals, nominal, remark, described)


def _damped(model: LinearModel) -> tuple[Floats, float]:
    """The area-weighted influence function in sag with N damping rows below, (P + N, N), and the damping."""
    matrix = np.sqrt(model.points.weight)[:, None] * remove_piston_tilt(model.influence_sag.T, model.points).T
    damping = DAMPING * float(np.linalg.norm(matrix, 2))
    return np.vstack((matrix, damping * np.eye(matrix.shape[1]))), damping


def _unbounded(target: Floats, model: LinearModel) -> Floats:
    matrix, _ = _damped(model)
    wanted = np.sqrt(model.points.weight) * remove_piston_tilt(target[None, :], model.points)[0]
    return np.asarray(np.linalg.lstsq(matrix, np.concatenate((wanted, np.zeros(matrix.shape[1]))), rcond=None)[0])
