"""The measured maps of a calibration, one row each, with their commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np

from dm_common import Bools, Floats, Ints
from dm_common.measurement import Measurement
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import PISTON_TILT
from dm_common.values import check_array

#: Assumed time from the end of a degauss to the first map, s, if not known; it affects only creep that soon ends.
BEFORE_FIRST_MAP_S = 1.0
#: Fewest pairs of maps of the same command from which the noise is estimated.
PAIRS_MIN = 3


class StepKind(StrEnum):
    """Kinds of the steps of a calibration, and of the maps with which they end."""

    REFERENCE = "reference"
    POKE = "poke"
    SURFACE = "surface"
    EXCITATION = "excitation"
    #: Also excites hysteresis, but with an in-use shape, see `dm_calibration.hysteresis.excitation`.
    IN_USE = "in_use"
    CHECK = "check"
    #: A map at mid range after a degauss within a run.
    DEGAUSSED = "degaussed"
    #: The only step without a map.
    DEGAUSS = "degauss"


def same_points(a: SamplePoints, b: SamplePoints) -> bool:
    """Whether both are the same points with the same weights, up to rounding."""
    return a.x.shape == b.x.shape and all(
        np.allclose(one, other, rtol=0.0, atol=1e-9) for one, other in ((a.x, b.x), (a.y, b.y), (a.weight, b.weight))
    )


@dataclass(frozen=True)
class MapSet:
    """M maps as columns; see :class:`~dm_common.measurement.Measurement` for their meaning and units."""

    points: SamplePoints
    label: tuple[str, ...]
    kind: tuple[str, ...]
    step: Ints
    signals: Floats
    applied: Floats
    stamp_ns: Ints
    coefficients: Floats
    sigma: Floats
    sag: Floats
    residual_rms: Floats
    valid_fraction: Floats
    file: tuple[str, ...]
    sha256: tuple[str, ...]
    nominal: Floats
    moved_ns: Ints
    segment: Ints
    temperature: Floats

    def __post_init__(self) -> None:
        points = self.points
        if not (points.x.shape == points.y.shape == points.weight.shape and points.x.ndim == 1 and points.x.size):
            raise ValueError(f"sampling points: x {points.x.shape}, y {points.y.shape}, weight {points.weight.shape}")
        if self.coefficients.ndim != 2 or self.signals.ndim != 2 or not len(self.coefficients):
            raise ValueError(f"coefficients {self.coefficients.shape}, signals {self.signals.shape}: rows of maps")
        count, terms = self.coefficients.shape
        expected = (
            ((count,), ("step", "stamp_ns", "residual_rms", "valid_fraction", "moved_ns", "segment", "temperature")),
            ((count, terms), ("sigma", "nominal")),
            ((count, self.actuators), ("signals", "applied")),
            ((count, points.x.size), ("sag",)),
        )
        for shape, names in expected:
            for name in names:
                check_array(name, getattr(self, name), shape, finite=False)
        for name in ("label", "kind", "file", "sha256"):
            if len(getattr(self, name)) != count:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries: must be {count}")
        if len(set(self.label)) != count:
            raise ValueError("labels of maps must be unique")

    def __len__(self) -> int:
        return len(self.label)

    @property
    def actuators(self) -> int:
        return int(self.signals.shape[1])

    @property
    def terms(self) -> int:
        return int(self.coefficients.shape[1])

    @property
    def reference(self) -> Bools:
        """(M,) which maps are reference frames."""
        return np.array([kind == StepKind.REFERENCE for kind in self.kind], dtype=bool)

    @property
    def has_map(self) -> Bools:
        """(M,) which hold a map; the others are commands without one, for the history of the actuators."""
        return np.asarray(np.isfinite(np.hstack((self.coefficients, self.sag))).any(axis=1))

    @property
    def degaussed(self) -> Bools:
        """(M,) which maps directly follow a degauss within the run."""
        again = np.concatenate(([False], np.diff(self.step) == 0))
        return np.array([kind == StepKind.DEGAUSSED for kind in self.kind], dtype=bool) & ~again

    @property
    def rest(self) -> float:
        """Signal of mid range, where reference frames are taken and a degauss ends, rounded to four decimals.

        The median, since actuators without a channel stand elsewhere. 0 if there is no reference frame.
        """
        return round(float(np.median(self.applied[self.reference])), 4) if self.reference.any() else 0.0

    def moved_s(self) -> Floats:
        """(M,) s since the first map: when the mirror took each shape. If that is not known, and after a degauss
        (creep follows the middle of its swings): right after the map before or, for the first map, after the degauss.
        """
        before = np.concatenate((self.stamp_ns[:1] - round(1e9 * BEFORE_FIRST_MAP_S), self.stamp_ns[:-1]))
        resumed = np.concatenate(([False], np.diff(self.segment) != 0))
        before = np.where(resumed, self.stamp_ns, before)  # the shapes before are not known
        plausible = (self.moved_ns > 0) & (self.moved_ns <= self.stamp_ns) & ~self.degaussed
        plausible[1:] &= self.moved_ns[1:] >= self.stamp_ns[:-1]
        return np.asarray(1e-9 * (np.where(plausible, self.moved_ns, before) - self.stamp_ns[0]))

    def noise_variance(self) -> Floats:
        """(K - 3,) m^2, variance of the coefficients of one map, from successive maps of the same command; 0 if
        these are too few.
        """
        same = (np.diff(self.applied, axis=0) == 0.0).all(axis=1) & (np.diff(self.segment) == 0) & ~self.degaussed[1:]
        change = np.diff(self.coefficients[:, PISTON_TILT:], axis=0)[same]
        change = change[np.isfinite(change).all(axis=1)]
        return 0.5 * np.square(change).mean(axis=0) if len(change) >= PAIRS_MIN else np.zeros(change.shape[1])

    def rejected(self, reasons: Sequence[str]) -> list[tuple[str, str]]:
        """Label and reason of each map measured that a fit has left out, by its `reasons` (M,); "" = it has not."""
        rows = zip(self.label, reasons, self.has_map, strict=True)
        return [(label, reason) for label, reason, seen in rows if reason and seen]

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Names of the fields with one entry per map."""
        return tuple(field.name for field in fields(cls) if field.name != "points")

    @classmethod
    def of(cls, measured: Sequence[Measurement]) -> MapSet:
        """Stack maps of the same points, at least one, in the order measured.

        Raises:
            ValueError: lengths differ between maps.
        """
        unknown = np.full(measured[0].coefficients.shape, np.nan)
        columns: dict[str, Any] = {"points": measured[0].points}
        for name in cls.columns():
            values = [getattr(one, name) for one in measured]
            if name == "nominal":
                values = [unknown if value is None else value for value in values]
            columns[name] = tuple(values) if isinstance(values[0], str) else np.array(values)
        return cls(**columns)

    def select(self, keep: Bools) -> MapSet:
        """The maps where `keep` (M,) is true."""
        rows = np.flatnonzero(keep)
        changes: dict[str, Any] = {}
        for name in self.columns():
            values = getattr(self, name)
            changes[name] = values[rows] if isinstance(values, np.ndarray) else tuple(values[i] for i in rows)
        return replace(self, **changes)
