"""Thin optics of a camera behind a deformable mirror: object distance, dioptre and curvature, each from the others.

The path: object, an afocal relay (or none), mirror, lens, sensor. Vergences are 1 / distance in dioptre. An object at
distance s in front of the entrance pupil arrives with the vergence -1/s, which a relay that widens the beam m times
makes -1/(m^2 s). A mirror of curvature c adds 2 c k: k = 1 at normal incidence; at the angle of incidence i a sphere
has the powers 2 c / cos i and 2 c cos i in its two planes, and k is their mean, (1/cos i + cos i) / 2. What then
focuses on the sensor is fixed by the lens: an object at vergence -V at the mirror, V the rest vergence, is sharp while
the mirror is flat. Hence an object is in focus when

    1/s = m^2 (2 c k + V),

linear in c. A lens of focal length f with the sensor a distance b behind it, at a distance d behind the mirror,
focuses on the vergence -N with N = 1/f - 1/b at itself, and on V = N / (1 - d N) at the mirror (the vergence v becomes
v / (1 - d v) over the path d).

Conventions: distances of objects in m from the camera's reference point; dioptre = 1 / distance, 0 = infinity, as in
libcamera (`LensPosition` [26]) and Android (`LENS_FOCUS_DISTANCE` [27]); positive curvature = concave; mirror power = 2
x curvature. Source: [2], sections 4.4 and 4.6 (oblique powers by Coddington).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from dm_common import Floats
from dm_common.errors import CodedError, ErrorCode
from dm_common.values import parameter, real


class OpticsError(CodedError, ValueError):
    """A distance, dioptre or optical parameter outside its range; the message names field, value and range."""

    error_code = ErrorCode.OUT_OF_RANGE


@dataclass(frozen=True)
class FocusOptics:
    """Where the camera focuses for a curvature of the mirror.

    Attributes:
        rest_dioptre: V, vergence at the mirror that is in focus while the mirror is flat [1/m].
        relay_magnification, incidence, pupil_offset: m, the angle i [rad] and a length [m], see the parameters.

    Raises:
        OpticsError: a value that is not finite, a magnification that is not above 0, or an angle from pi/2 on.
    """

    rest_dioptre: float = 0.0
    relay_magnification: float = parameter(
        real(1.0, 0.01, 100.0), "Diameter of the beam on the mirror / diameter of the entrance pupil."
    )
    incidence: float = parameter(real(0.0, 0.0, math.pi / 3, "rad"), "Angle of incidence on the mirror.")
    pupil_offset: float = parameter(
        real(0.0, -100.0, 100.0, "m"),
        "Distance of the entrance pupil behind the point from which object distances count.",
    )

    def __post_init__(self) -> None:
        for name in ("rest_dioptre", "pupil_offset"):
            if not math.isfinite(getattr(self, name)):
                raise OpticsError(f"{name} = {getattr(self, name)}: must be finite")
        if not (math.isfinite(self.relay_magnification) and self.relay_magnification > 0):
            raise OpticsError(f"relay_magnification = {self.relay_magnification}: must be above 0")
        if not 0 <= self.incidence < math.pi / 2:
            raise OpticsError(f"incidence = {self.incidence} rad: must be from 0 to below pi/2")

    @classmethod
    def from_rest_distance(cls, rest_distance: float, **others: float) -> Self:
        """The optics of a camera that is in focus at `rest_distance` (m, 0 or inf = infinity) while the mirror is flat.

        Args:
            others: the attributes other than `rest_dioptre`.

        Raises:
            OpticsError: an object inside the camera, and see the class.
        """
        blank = cls(**others)
        rest = blank._pupil_dioptre(dioptre_of(rest_distance, "rest_distance"))
        return replace(blank, rest_dioptre=rest / blank.relay_magnification**2)

    def curvature_for(self, dioptre: float) -> float:
        """Curvature [1/m] that focuses on the dioptre 1 / distance [1/m]; below 0 = beyond infinity.

        Raises:
            OpticsError: not finite, or an object inside the camera (`pupil_offset` < 0).
        """
        if not math.isfinite(dioptre):
            raise OpticsError(f"dioptre = {dioptre}: must be finite")
        vergence = self._pupil_dioptre(dioptre) / self.relay_magnification**2
        return (vergence - self.rest_dioptre) / (2 * self._oblique)

    def dioptre_for(self, curvature: float) -> float:
        """Dioptre 1 / distance [1/m] in focus at a curvature [1/m]; below 0 = beyond infinity, NaN = inside the camera.

        NaN means: even an object at the reference point lies farther than the focus (`pupil_offset` > 0).

        Raises:
            OpticsError: the curvature is not finite.
        """
        if not math.isfinite(curvature):
            raise OpticsError(f"curvature = {curvature} 1/m: must be finite")
        at_pupil = self._at_pupil(curvature)
        rest = 1 - at_pupil * self.pupil_offset
        if rest > 0:
            return at_pupil / rest
        return math.nan if at_pupil > 0 else -math.inf

    def distances_for(self, curvature: Floats) -> Floats:
        """Distances [m] in focus at curvatures [1/m], any shape: inf = infinity and beyond, NaN = inside the camera.

        Curvatures of NaN, -inf and inf give NaN, inf and -inf: "nothing", "too far" and "too near" of REP 117.
        """
        with np.errstate(all="ignore"):
            at_pupil = self._at_pupil(curvature)
            rest = 1 - at_pupil * self.pupil_offset
            distance = np.where(at_pupil > 0, rest / at_pupil, np.inf)
        ends = [curvature == -np.inf, curvature == np.inf, ~((rest > 0) | (at_pupil < 0))]
        return np.select(ends, [np.inf, -np.inf, np.nan], distance)

    def _at_pupil(self, curvature: Any) -> Any:
        """1 / (distance + pupil_offset) in focus at a curvature, or at many."""
        return self.relay_magnification**2 * (2 * curvature * self._oblique + self.rest_dioptre)

    @property
    def _oblique(self) -> float:
        return (1 / math.cos(self.incidence) + math.cos(self.incidence)) / 2

    def _pupil_dioptre(self, dioptre: float) -> float:
        """1 / (distance + pupil_offset) from 1 / distance."""
        scale = 1 + dioptre * self.pupil_offset
        if scale <= 0:
            raise OpticsError(
                f"dioptre = {dioptre:g} 1/m: the object would lie inside the camera; with a pupil offset of "
                f"{self.pupil_offset:g} m it must be {'below' if self.pupil_offset < 0 else 'above'} "
                f"{-1 / self.pupil_offset:g} 1/m"
            )
        return dioptre / scale


def dioptre_of(distance: float, name: str = "distance") -> float:
    """1 / distance; a distance [m] of 0 or inf means infinity, dioptre 0. Raises OpticsError if negative or NaN."""
    if math.isnan(distance) or distance < 0:
        raise OpticsError(f"{name} = {distance} m: must be above 0, or 0 or inf for infinity")
    return 1 / distance if distance > 0 and math.isfinite(distance) else 0.0


def distance_of(dioptre: float) -> float:
    """1 / dioptre [m]; inf from 0 on down (infinity and beyond), NaN stays."""
    return math.nan if math.isnan(dioptre) else 1 / dioptre if dioptre > 0 else math.inf


def rest_dioptre_of_lens(focal_length: float, sensor_distance: float, mirror_distance: float = 0.0) -> float:
    """Rest vergence V [1/m] at the mirror of a lens and its sensor: the closed form at the head of this module.

    Args:
        focal_length: of the lens, f [m], above 0.
        sensor_distance: from lens to sensor, b [m], above 0; equal to f = the lens is focused at infinity.
        mirror_distance: from mirror to lens, d [m], 0 or more.

    Raises:
        OpticsError: a value outside its range, or a lens that focuses between itself and the mirror.
    """
    if not (math.isfinite(focal_length) and focal_length > 0):
        raise OpticsError(f"focal_length = {focal_length} m: must be above 0")
    if not (math.isfinite(sensor_distance) and sensor_distance > 0):
        raise OpticsError(f"sensor_distance = {sensor_distance} m: must be above 0")
    if not (math.isfinite(mirror_distance) and mirror_distance >= 0):
        raise OpticsError(f"mirror_distance = {mirror_distance} m: must be 0 or more")
    at_lens = 1 / focal_length - 1 / sensor_distance
    if mirror_distance * at_lens >= 1:
        raise OpticsError(
            f"sensor_distance = {sensor_distance:g} m: the lens focuses {1 / at_lens:g} m in front of itself, "
            f"between itself and the mirror {mirror_distance:g} m away"
        )
    return at_lens / (1 - mirror_distance * at_lens)


def depth_of_focus(aperture_radius: float, wavelength: float = 550e-9) -> float:
    """Curvature error [1/m] at which the wavefront is a quarter wave off at the edge: lambda / (4 a^2).

    The wavefront of the curvature error e is e r^2 (twice the sag e r^2 / 2); Rayleigh's criterion ([2],
    section 9.3) sets it to lambda / 4 at the edge a of the aperture.

    Args:
        aperture_radius: a of the beam on the mirror [m], above 0.
        wavelength: [m], above 0.

    Raises:
        OpticsError: a value outside its range.
    """
    for name, value in (("aperture_radius", aperture_radius), ("wavelength", wavelength)):
        if not (math.isfinite(value) and value > 0):
            raise OpticsError(f"{name} = {value} m: must be above 0")
    return wavelength / (4 * aperture_radius**2)
