"""The measured maps of a calibration, one row each: what was commanded and what the interferometer saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.sampling import SamplePoints

Floats = NDArray[np.float64]

REFERENCE = "reference"
POKE = "poke"
SURFACE = "surface"
EXCITATION = "excitation"
CHECK = "check"
KINDS = (REFERENCE, POKE, SURFACE, EXCITATION, CHECK)


def same_points(a: SamplePoints, b: SamplePoints) -> bool:
    """Whether both are the same points with the same weights, up to rounding."""
    return a.x.shape == b.x.shape and all(
        np.allclose(one, other, rtol=0.0, atol=1e-9) for one, other in ((a.x, b.x), (a.y, b.y), (a.weight, b.weight))
    )


@dataclass(frozen=True)
class MapRecord:
    """One measured map.

    Attributes:
        label: unique in a calibration, e.g. ``poke+07``, ``p55``, ``reference 3``.
        kind: REFERENCE, POKE, SURFACE, EXCITATION (shows the memory) or CHECK (a move as in use, tests the law of it).
        step: index of the commanded state; maps repeated in one state share it.
        signals, applied: (N,) normalised signals as requested and as written to the electronics.
        stamp_ns: time of the measurement, ns.
        coefficients, sigma: (K,) Zernike coefficients and their standard deviations (NaN = unknown), m.
        sag: (P,) at the sampling points, m; NaN = no data.
        residual_rms: what the K terms leave unexplained, m.
        valid_fraction: valid pixels of the aperture, 0..1.
        file, sha256: the map file it came from; "" = none.
        nominal: (K,) coefficients of the surface that was aimed at, m; None when signals were prescribed.
        moved_ns: when the mirror took this shape, ns; 0 = not told.
        segment: number of the degauss, or of the resumption, from which the history of the actuators is known; 0 for a
            run that was not interrupted.
    """

    label: str
    kind: str
    step: int
    signals: Floats
    applied: Floats
    stamp_ns: int
    coefficients: Floats
    sigma: Floats
    sag: Floats
    residual_rms: float
    valid_fraction: float
    file: str = ""
    sha256: str = ""
    nominal: Floats | None = None
    moved_ns: int = 0
    segment: int = 0


@dataclass(frozen=True)
class MapSet:
    """M maps column by column; see :class:`MapRecord` for the meaning and unit of each column."""

    points: SamplePoints
    label: tuple[str, ...]
    kind: tuple[str, ...]
    step: NDArray[np.int64]
    signals: Floats
    applied: Floats
    stamp_ns: NDArray[np.int64]
    coefficients: Floats
    sigma: Floats
    sag: Floats
    residual_rms: Floats
    valid_fraction: Floats
    file: tuple[str, ...]
    sha256: tuple[str, ...]
    nominal: Floats
    moved_ns: NDArray[np.int64]
    segment: NDArray[np.int64]

    def __post_init__(self) -> None:
        points = self.points
        if not (points.x.shape == points.y.shape == points.weight.shape and points.x.ndim == 1 and points.x.size):
            raise ValueError(f"sampling points: x {points.x.shape}, y {points.y.shape}, weight {points.weight.shape}")
        count, terms = self.coefficients.shape
        expected = {
            "step": (count,),
            "signals": (count, self.signals.shape[-1]),
            "applied": self.signals.shape,
            "stamp_ns": (count,),
            "sigma": (count, terms),
            "sag": (count, self.points.x.size),
            "residual_rms": (count,),
            "valid_fraction": (count,),
            "nominal": (count, terms),
            "moved_ns": (count,),
            "segment": (count,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has the shape {getattr(self, name).shape}: must be {shape}")
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
    def reference(self) -> NDArray[np.bool_]:
        """(M,) which maps are reference frames."""
        return np.array([kind == REFERENCE for kind in self.kind], dtype=bool)

    def moved_s(self) -> Floats:
        """(M,) s since the first map: when the mirror took each shape; right after the map before where not told."""
        before = np.concatenate((self.stamp_ns[:1], self.stamp_ns[:-1]))
        resumed = np.concatenate(([False], np.diff(self.segment) != 0))
        before = np.where(resumed, self.stamp_ns, before)  # nobody knows what was before
        told = (self.moved_ns > 0) & (self.moved_ns <= self.stamp_ns)
        told[1:] &= self.moved_ns[1:] >= self.stamp_ns[:-1]
        return np.asarray(1e-9 * (np.where(told, self.moved_ns, before) - self.stamp_ns[0]))

    @classmethod
    def from_records(cls, records: Sequence[MapRecord], points: SamplePoints) -> MapSet:
        """Stack `records`, in the order measured.

        Raises:
            ValueError: when there is none, or lengths differ between records.
        """
        if not records:
            raise ValueError("no maps were measured")
        unknown = np.full(records[0].coefficients.shape, np.nan)
        return cls(
            points=points,
            label=tuple(record.label for record in records),
            kind=tuple(record.kind for record in records),
            step=np.array([record.step for record in records], dtype=np.int64),
            signals=np.stack([record.signals for record in records]),
            applied=np.stack([record.applied for record in records]),
            stamp_ns=np.array([record.stamp_ns for record in records], dtype=np.int64),
            coefficients=np.stack([record.coefficients for record in records]),
            sigma=np.stack([record.sigma for record in records]),
            sag=np.stack([record.sag for record in records]),
            residual_rms=np.array([record.residual_rms for record in records]),
            valid_fraction=np.array([record.valid_fraction for record in records]),
            file=tuple(record.file for record in records),
            sha256=tuple(record.sha256 for record in records),
            nominal=np.stack([unknown if record.nominal is None else record.nominal for record in records]),
            moved_ns=np.array([record.moved_ns for record in records], dtype=np.int64),
            segment=np.array([record.segment for record in records], dtype=np.int64),
        )

    def select(self, keep: NDArray[np.bool_]) -> MapSet:
        """The maps where `keep` (M,) is true."""
        rows = np.flatnonzero(keep)
        changes: dict[str, Any] = {}
        for column in fields(self):
            values = getattr(self, column.name)
            if isinstance(values, np.ndarray):
                changes[column.name] = values[rows]
            elif isinstance(values, tuple):
                changes[column.name] = tuple(values[i] for i in rows)
        return replace(self, **changes)
