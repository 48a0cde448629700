"""Command and prediction of a target as one product of a matrix with the target's few amplitudes.

As long as no limit binds, the command is linear in the wanted sag, and wanted sag is linear in the amplitudes of a
short series in the radius, the added Zernike terms and the figure. So all that has to be worked out per request are
some eighty sums of five products; with added terms, of twenty-six.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common.optics.conic_series import ORDERS, series, series_coefficients, series_sag
from dm_common.optics.zernike import TERMS, basis
from dm_controller.planning.target import FocusTarget

Floats = NDArray[np.float64]


class Found(NamedTuple):
    """Signals (N,) that no limit knows of yet, and what would remain.

    Attributes:
        largest: m, coefficient error.
        remaining: as long as the rms sag error, m.
    """

    signals: Floats
    largest: float
    remaining: Floats


class ClosedForm:
    """For one mirror.

    Args:
        radius: of the aperture, m.
        points: (x, y) of the P points, unit disc.
        coefficients_offset: (21,) m at zero signals.
        sag_offset: (P,) m at zero signals.
        solve: commands (N, M) without limits for wanted coefficients (21, M) and sag (P, M).
        errors: coefficient errors beyond tilt (E, M) and weighted sag errors (P, M), piston and tilt removed, of
            commands (N, M) and what was wanted.
    """

    def __init__(
        self,
        radius: float,
        points: tuple[Floats, Floats],
        coefficients_offset: Floats,
        sag_offset: Floats,
        solve: Callable[[Floats, Floats], Floats],
        errors: Callable[[Floats, Floats, Floats], tuple[Floats, Floats]],
    ) -> None:
        self._radius = radius
        x, y = points
        # Columns: the figure with the amplitude 1, the series, the added terms.
        coefficients = np.column_stack([-coefficients_offset, series_coefficients(), np.eye(len(TERMS))])
        sag = np.column_stack([-sag_offset, series_sag(x, y), basis(x, y)])
        signals = solve(coefficients, sag)
        terms, remaining = errors(signals, coefficients, sag)
        # The norm of `remaining` times amplitudes is that of its triangle times them.
        triangle = np.linalg.qr(remaining)[1]
        self._whole = np.ascontiguousarray(np.vstack([signals, terms, triangle]))
        # A triangle's first columns are zero below their number.
        rows = len(signals) + len(terms) + 1 + ORDERS
        self._conic = np.ascontiguousarray(self._whole[:rows, : 1 + ORDERS])
        self._signals, self._terms = len(signals), len(signals) + len(terms)

    def find(self, target: FocusTarget) -> Found | None:
        """None where the series is too short for the target; that one is told by its exact sag."""
        conic = series(target.curvature, target.conic_constant, self._radius)
        if conic is None:
            return None
        if target.zernike:
            result = self._whole @ np.array([1.0, *conic, *target.zernike])
        else:
            result = self._conic @ np.array((1.0, *conic))
        errors = np.abs(result[self._signals : self._terms])
        return Found(result[: self._signals], float(np.maximum.reduce(errors)), result[self._terms :])
