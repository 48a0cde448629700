"""The surface at rest as it drifts during a calibration, followed through the reference frames.

Each map is modelled as ``figure(t) + G s``. ``figure(t)`` is a straight line between reference frames, and its values
at the frames are unknowns of the *same* regression as G. Subtracting the interpolated reference frame instead would be
the special case in which the frames are taken as free of error: the noise of one frame, and the remanence that the
hysteresis left in it, would then enter every map of two intervals alike. Here all maps of an interval share in fixing
its figure, and the frames are as uncertain as any other map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def drift_columns(stamp_ns: NDArray[np.int64], reference: NDArray[np.bool_]) -> Floats:
    """(M, R) columns of the design: hat functions of time with a knot at each distinct time of a reference frame.

    Before the first and after the last frame the figure is taken as constant. Rows sum to 1. With fewer than two
    distinct reference times there is one column of ones: a constant figure. When the clock was set back during the
    run, the order of the maps stands for the time.
    """
    if (np.diff(stamp_ns) < 0).any():
        stamp_ns = np.arange(stamp_ns.size, dtype=np.int64)
    knots = np.unique(stamp_ns[reference])
    if knots.size < 2:
        return np.ones((stamp_ns.size, 1))
    seconds = (stamp_ns - knots[0]) * 1e-9
    knot_seconds = (knots - knots[0]) * 1e-9
    columns = [np.interp(seconds, knot_seconds, unit) for unit in np.eye(knots.size)]
    return np.column_stack(columns)
