"""Region weights, Eqs. (7) and (8) in [1]: their derivation from errors, why they cancel, and where they act.

Eq. (8) gives each concentric region a weight from the variance r_i, over the sample surfaces, of the rms surface
control error inside it. Eq. (7) puts these weights, as a diagonal matrix W, on the rows of dC - G dS. With G free that
changes nothing: the Frobenius norm is a sum over rows, each row of G occurs in one term of it only, and a factor in
front of a term does not move its minimum. `studies.paper.weights_cancel` shows it on data.

Weights act only where measurements of several regions share unknowns. There are two such places:

(a) The 21 coefficients of a map are shared by all its points. Fitted to the sag with the points of region i weighted by
    w_i (:func:`coefficient_operator`) they describe the lightly weighted regions less well and the others better;
    Eq. (6) on these coefficients gives another G. This is what the method "AZWreg" of the influence function means.
(b) The signals are shared by all points of the wanted surface, which outnumber the actuators:
    min over ds of |W(dC - G dS)| on the vector of sag points (:func:`command_row_weights`). This is what the solver
    "AZWreg" of a controller means.

The ten regions are nested, so "the points of region i" has two readings: each point belongs to the smallest disc that
contains it (the ring between two discs), or it counts once in every disc that contains it, w_j^2 + ... + w_10^2 in all.
Here the first is used: w_i then acts on region i alone, and equal weights are no weights. In the second reading, even
equal weights favour the centre ten to one.
"""

import numpy as np
from numpy.typing import ArrayLike

from dm_calibration.influence.regression import RANK_TOLERANCE
from dm_common import Floats
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sample_regions import point_weights
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import TERMS, basis


def region_weights(variance: ArrayLike, epsilon: float) -> Floats:
    """Eq. (8): w_i = (1 + (r_i / epsilon)^2)^(-1/2).

    Args:
        variance: (R,) r_i, m^2, variance over the sample surfaces of the rms error inside region i.
        epsilon: m^2, the prior parameter; variances far below it have weight 1.

    Returns:
        (R,) above 0, at most 1.

    Raises:
        ValueError: epsilon not above 0, or a variance negative or not finite.
    """
    r = np.asarray(variance, dtype=float)
    check_epsilon(epsilon)
    if r.ndim != 1 or not r.size or not (np.isfinite(r) & (r >= 0.0)).all():
        raise ValueError(f"variance = {r.tolist()}: must be one finite number of m^2, 0 or more, per region")
    return np.asarray(1.0 / np.hypot(1.0, r / epsilon))


def check_epsilon(epsilon: float) -> None:
    """Raise ValueError unless `epsilon` (m^2) can be the prior parameter of Eq. (8)."""
    if not (np.isfinite(epsilon) and epsilon > 0.0):
        raise ValueError(
            f"epsilon = {epsilon:g} m^2: must be above 0 and finite; the median of the variances is a start"
        )


def surface_control_error(sag: Floats, signals: Floats, influence_zernike: Floats, points: SamplePoints) -> Floats:
    """Measured sag less its nominal surface, piston and tilt removed: the surface control error of [1], section 2.2.

    The nominal surface is G s, the prediction by 21 terms for the signals, without offset. So the error contains the
    initial figure, the print-through beyond 21 terms and the hysteresis.

    Args:
        sag: (M, P) m; NaN = no data, stays NaN.
        signals: (M, N).
        influence_zernike: (21, N) m per unit signal.

    Returns:
        (M, P) m.
    """
    if influence_zernike.shape != (len(TERMS), signals.shape[-1]):
        raise ValueError(
            f"influence_zernike has the shape {influence_zernike.shape}: must be ({len(TERMS)}, {signals.shape[-1]})"
        )
    nominal = (signals @ influence_zernike.T) @ basis(points.x, points.y).T
    return remove_piston_tilt(sag - nominal, points)


def coefficient_operator(points: SamplePoints, weights: ArrayLike) -> Floats:
    """Place (a): the linear map from sag at the points to the 21 coefficients, points weighted by area and region.

    Args:
        weights: (R,) of the regions.

    Returns:
        (21, P): coefficients (M, 21) = sag (M, P) @ operator.T, in the unit of the sag.

    Raises:
        ValueError: fewer points than terms, or points that do not tell the terms apart.
    """
    if len(points) < len(TERMS):
        raise ValueError(
            f"{len(points)} sampling points for {len(TERMS)} coefficients: at least {len(TERMS)} are needed"
        )
    row = np.sqrt(points.weight) * point_weights(points, weights)
    weighted = row[:, np.newaxis] * basis(points.x, points.y)
    if np.linalg.cond(weighted) > 1.0 / RANK_TOLERANCE:
        raise ValueError(
            f"the {len(points)} sampling points do not separate the {len(TERMS)} terms: spread the points over the "
            "aperture"
        )
    return np.asarray(np.linalg.pinv(weighted) * row)
