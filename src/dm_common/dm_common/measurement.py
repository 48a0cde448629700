"""Maps as measurements, and the bench that a calibration drives. Independent of ROS."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Protocol

import numpy as np

from dm_common import Floats
from dm_common.optics.sampling import SamplePoints


@dataclass(frozen=True, eq=False)
class Setup:
    """What a map was taken with, and how it was evaluated: all maps of a fit must share it.

    Attributes:
        points: where the map was sampled.
        wavelength: m; 0 = unknown.
        system_error_subtracted: whether the instrument itself subtracted its error: 1 yes, 0 no, -1 not known.
        instrument: that took the map, with its serial number; "" = not known.
        pitch: m per pixel; 0 = unknown.
        camera: width and height of the map, pixels; zeros = not known.
        orientation: how the instrument's picture was turned: flips of x and y, then counter-clockwise by degrees.
        reference_surface: instrument errors subtracted, as text: map with SHA-256, retrace, distortion; "" = none.
        instrument_error: 95 % bound on the instrument error that remains in a coefficient, m; 0 = not known.
        scale_error: 95 % bound on the relative error of pitch and radius; 0 = not known.
    """

    points: SamplePoints
    wavelength: float = 0.0
    system_error_subtracted: int = -1
    instrument: str = ""
    pitch: float = 0.0
    camera: tuple[int, int] = (0, 0)
    orientation: tuple[bool, bool, float] = (False, False, 0.0)
    reference_surface: str = ""
    instrument_error: float = 0.0
    scale_error: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement(Setup):
    """One measured map and, in a run or a calibration, its command.

    Attributes:
        sag: (P,) at the points, m; NaN = no data.
        coefficients, sigma: (K,) Zernike coefficients and their standard deviations (NaN = unknown), m.
        stamp_ns: time of the measurement, ns; 0 = not known.
        residual_rms: rms of the map less its K terms, m.
        valid_fraction: valid pixels of the aperture, 0..1.
        radius: of the aperture the coefficients and points are normalised to, m; 0 = unknown.
        file, sha256: the map file it came from; "" = none.
        moved_ns: when the mirror took the shape, ns; 0 = not known.
        centre: of the aperture from the left and top edge of the map, pixels; NaN = not known.
        followed: centre of the valid region if the aperture follows it, as `centre`; zeros = it does not.
        radius_px: of the aperture, pixels; 0 = not known.
        label: unique in a calibration, e.g. ``poke+07``, ``p55``, ``reference 3``; "" = not commanded by a run.
        kind: as `dm_calibration.influence.maps.StepKind`, e.g. reference or poke; "" = not of a calibration.
        step: index of the commanded state; maps repeated in one state share it.
        signals, applied: (N,) normalised signals as requested and as written to the electronics.
        nominal: (K,) coefficients of the intended surface, m; None when signals were prescribed.
        segment: number of the degauss, or of the resumption, from which the history of the actuators is known; 0 for a
            run that was not interrupted.
        temperature: of the mirror, degC; NaN = not known.
    """

    sag: Floats
    coefficients: Floats
    sigma: Floats
    stamp_ns: int
    residual_rms: float
    valid_fraction: float
    radius: float = 0.0
    file: str = ""
    sha256: str = ""
    moved_ns: int = 0
    centre: tuple[float, float] = (float("nan"), float("nan"))
    followed: tuple[float, float] = (0.0, 0.0)
    radius_px: float = 0.0
    label: str = ""
    kind: str = ""
    step: int = 0
    signals: Floats = field(default_factory=lambda: np.zeros(0))
    applied: Floats = field(default_factory=lambda: np.zeros(0))
    nominal: Floats | None = None
    segment: int = 0
    temperature: float = float("nan")

    @property
    def has_map(self) -> bool:
        """Whether there is a map, not only a command that belongs to the history of the actuators."""
        return bool(np.isfinite(self.coefficients).any() or np.isfinite(self.sag).any())

    @property
    def setup(self) -> Setup:
        """The setup alone."""
        return Setup(**{shared.name: getattr(self, shared.name) for shared in fields(Setup)})

    def same_map(self, other: Measurement) -> bool:
        """Whether both are the same map: the same known stamp, or the same file under another stamp.

        A file that was already measured may be ingested again, with the time in its header; two different maps never
        share their coefficients to the last bit.
        """
        return self.stamp_ns == other.stamp_ns != 0 or bool(np.array_equal(self.coefficients, other.coefficients))


class Bench(Protocol):
    """The mirror and the interferometer that a calibration procedure drives."""

    def degauss(self) -> None:
        """Remove the hysteresis and end at rest. Raises Refusal."""

    def apply(self, signals: Floats) -> Floats:
        """Command `signals` (N,), wait until they are reached, return what was written (N,). Raises Refusal."""

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        """Wait this `share` of the settle time and `dwell` s more; False when cancelled meanwhile."""

    def measure(self, label: str) -> Measurement:
        """Take one map. Raises MeasurementError, or Refusal when no other try can succeed."""
