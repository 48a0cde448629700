"""The outcome of an ablation, and its figures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dm_common import Floats
from studies.comparison.compare import peak_to_valley


@dataclass(frozen=True, eq=False)
class Requests:
    """Outcomes of one sequence, or of several: R requests.

    Attributes:
        dwell: (R,) s.
        curvature: (R,) 1/m.
        max_zernike, upper: (R,) m, largest coefficient error of the true surface, and its predicted bound.
        rms, limit: (R,) m, sag error, and the smallest that this mirror could reach.
    """

    dwell: Floats
    curvature: Floats
    max_zernike: Floats
    upper: Floats
    rms: Floats
    limit: Floats

    @classmethod
    def pooled(cls, parts: Iterable[Requests]) -> Requests:
        parts = list(parts)
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))

    def held(self, dwell: float) -> Requests:
        keep = self.dwell == dwell
        return Requests(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Series:
    """One model on one plant after one history, all seeds together.

    Attributes:
        hold_1h: (S,) m, drift of a shape held for an hour, for each seed.
    """

    plant: str
    model: str
    history: str
    requests: Requests
    hold_1h: Floats


@dataclass(frozen=True)
class Identified:
    """Result of the identification on one simulation."""

    plant: str
    seed: int
    law: str
    held_out_max_zernike: float


@dataclass(frozen=True, eq=False)
class Ablation:
    """All series."""

    series: tuple[Series, ...]
    identified: tuple[Identified, ...]
    radius: float


@dataclass(frozen=True)
class RowFigures:
    """Figures of some requests.

    Attributes:
        p50, p90: m, of the largest coefficient error.
        rms_share: median of rms sag error over PV.
        excess_share: the same for the part beyond the fitting limit (root of the difference of squares).
        bound_coverage: share of requests whose error is inside the predicted bound.
    """

    requests: int
    p50: float
    p90: float
    rms_share: float
    excess_share: float
    bound_coverage: float


def figures_of(requests: Requests, radius: float) -> RowFigures:
    """Figures of `requests` on an aperture of `radius` (m)."""
    depth = np.array([peak_to_valley(c, radius) for c in requests.curvature])
    excess = np.sqrt(np.maximum(np.square(requests.rms) - np.square(requests.limit), 0.0))
    return RowFigures(
        requests=len(depth),
        p50=float(np.quantile(requests.max_zernike, 0.5)),
        p90=float(np.quantile(requests.max_zernike, 0.9)),
        rms_share=float(np.median(requests.rms / depth)),
        excess_share=float(np.median(excess / depth)),
        bound_coverage=float(np.mean(requests.max_zernike <= requests.upper)),
    )
