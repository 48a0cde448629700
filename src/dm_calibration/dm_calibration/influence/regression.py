"""Eq. (6): the influence function as an ordinary least-squares problem, and the two methods of [1].

Both methods regress by Eq. (6). AZreg takes coefficients fitted to all pixels of a map with equal weight; AZWreg takes
coefficients fitted to the sag with region weights (:mod:`~dm_calibration.influence.weights` explains why the weights of
Eq. (7) act there and nowhere in the regression).

The surface at rest drifts during a calibration, so each map is modelled as ``figure(t) + G s``. ``figure(t)`` is a
straight line between reference frames, and its values at the frames are unknowns of the *same* regression as G.
To subtract the interpolated reference frame instead would assume frames without errors: the noise of one frame, and the
remanence left in it by hysteresis, would then enter all maps of two intervals. Here all maps of an interval contribute
to its figure, and the frames are as uncertain as any other map.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from dm_calibration.influence.maps import MapSet
from dm_common import Bools, Floats, Ints
from dm_common.errors import CodedError, ErrorCode
from dm_common.mirror import actuators_text
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt, weighted_fit
from dm_common.optics.zernike import basis

#: Methods by the name used in messages and calibration files.
METHODS = ("AZreg", "AZWreg")
#: Least range of applied signals over the maps, normalised, for an actuator to count as excited: that of the smallest
#: pokes (a half-swing of 0.01), which converters round.
EXCITATION_MIN = 0.0199
#: Maps beyond the number of unknowns before the drift is followed; with fewer, the figure is taken as constant.
DRIFT_SPARE_MAPS = 5
#: Smallest singular value of the design, relative to the largest, that still separates the actuators.
RANK_TOLERANCE = 1e-7
#: Least share of the information on any combination of unknowns that the maps with data at a point must keep.
SEEN_MIN = 1e-6
#: Most rounds in which sampling points without data are filled from the fit, and the change, m, that ends them earlier.
GAP_ROUNDS = 60
GAP_TOLERANCE = 1e-11


class TooFewMapsError(CodedError, ValueError):
    """The maps do not determine the influence function; the message says what is missing."""

    error_code = ErrorCode.TOO_FEW_MAPS


@dataclass(frozen=True)
class Design:
    """The design of the regression.

    Attributes:
        matrix: (M, R + E) hat functions of the drifting figure, then the applied signals of the excited actuators.
        drift: R, number of drift columns.
        excited: (N,) which actuators have a column.
    """

    matrix: Floats
    drift: int
    excited: Bools

    @cached_property
    def basis(self) -> Floats:
        """(M, p) orthonormal columns that span the matrix."""
        return np.asarray(np.linalg.qr(self.matrix)[0])


@dataclass(frozen=True)
class Regression:
    """Outcome of one regression of Q responses on a design with p columns.

    Attributes:
        coefficients: (p, Q).
        residual: (M, Q).
        leverage: (M,) diagonal of the hat matrix; 1 = the map alone determines some unknown.
        covariance: (p, p) of the coefficients for responses of unit variance.
    """

    coefficients: Floats
    residual: Floats
    leverage: Floats
    covariance: Floats


def drift_columns(stamp_ns: Ints, reference: Bools, step: Ints, segment: Ints | None = None) -> Floats:
    """(M, R) columns of the design: hat functions of time with a knot at the mean time of each reference state.

    Repeated maps of a state, which follow each other, share its knot. Before the first and after the last knot the
    figure is constant. Rows sum to 1. With fewer than two knots there is one column of ones: a constant figure. If the
    clock was set back during the run, the order of the maps serves as time.

    Args:
        step: (M,) index of the commanded state.
        segment: (M,) number that changes where the run was resumed. Each part has knots of its own, since the figure
            may have changed in between; None = the run was not interrupted.
    """
    if segment is not None and (segment != segment[0]).any():
        parts = [segment == number for number in np.unique(segment)]
        blocks = [drift_columns(stamp_ns[part], reference[part], step[part]) for part in parts]
        columns = scipy.linalg.block_diag(*blocks)
        return np.asarray(columns[np.argsort(np.concatenate([np.flatnonzero(part) for part in parts]))])
    if (np.diff(stamp_ns) < 0).any():
        stamp_ns = np.arange(stamp_ns.size, dtype=np.int64)
    knots = np.unique([stamp_ns[reference & (step == state)].mean() for state in np.unique(step[reference])])
    if knots.size < 2:
        return np.ones((stamp_ns.size, 1))
    seconds = (stamp_ns - knots[0]) * 1e-9
    knot_seconds = (knots - knots[0]) * 1e-9
    columns = [np.interp(seconds, knot_seconds, unit) for unit in np.eye(knots.size)]
    return np.column_stack(columns)


def make_design(maps: MapSet) -> Design:
    """Design matrix of `maps`.

    Raises:
        TooFewMapsError: no actuator was moved, or fewer maps than unknowns.
    """
    excited = np.ptp(maps.applied, axis=0) >= EXCITATION_MIN
    count = int(excited.sum())
    if count == 0:
        raise TooFewMapsError(
            f"no actuator was moved by {EXCITATION_MIN:g} or more in the {len(maps)} good maps: raise poke_amplitude, "
            "or add surfaces that move the actuators"
        )
    drift = drift_columns(maps.stamp_ns, maps.reference, maps.step, maps.segment)
    if len(maps) < drift.shape[1] + count + DRIFT_SPARE_MAPS:
        drift = np.ones((len(maps), 1))
    unknowns = drift.shape[1] + count
    if len(maps) <= unknowns:
        raise TooFewMapsError(
            f"{len(maps)} good maps for {unknowns} unknowns ({count} actuators and the figure): "
            f"at least {unknowns + 1} are needed; measure more shapes, or leave out fewer maps"
        )
    return Design(np.hstack((drift, maps.applied[:, excited])), drift.shape[1], excited)


def least_squares(design: Design, responses: Floats) -> Regression:
    """Regress `responses` (M, Q) on the design by one QR decomposition.

    Raises:
        TooFewMapsError: some actuators always moved together; the message names them.
    """
    q, r = np.linalg.qr(design.matrix)
    _, singular, right = np.linalg.svd(r)
    if singular[-1] < RANK_TOLERANCE * singular[0]:
        null = right[singular < RANK_TOLERANCE * singular[0]][:, design.drift :]
        involved = np.flatnonzero(design.excited)[np.abs(null).max(axis=0) > 0.02] + 1
        which = actuators_text(involved) or "the actuators"
        raise TooFewMapsError(f"the maps do not separate {which}: each must move on its own in some map")
    coefficients = scipy.linalg.solve_triangular(r, q.T @ responses)
    inverse = scipy.linalg.solve_triangular(r, np.eye(r.shape[0]))
    return Regression(
        coefficients=coefficients,
        residual=responses - design.matrix @ coefficients,
        leverage=np.square(q).sum(axis=1),
        covariance=inverse @ inverse.T,
    )


class SeenAlike(NamedTuple):
    """Sampling points with data in the same maps, by index; p unknowns, L maps without data there.

    Attributes:
        lost: (L, p) rows of these L maps in the orthonormal basis of the design.
        inverse: (L, L) of 1 - lost lost^T; None where the other maps do not determine the unknowns.
    """

    points: Ints
    lost: Floats
    inverse: Floats | None


def seen_alike(design: Design, seen: Bools) -> list[SeenAlike]:
    """All sampling points, grouped by the set of maps that have data there, `seen` (M, P)."""
    _, first, which = np.unique(np.packbits(seen, axis=0), axis=1, return_index=True, return_inverse=True)
    found = []
    for number, rows in enumerate(seen[:, first].T):
        lost = design.basis[~rows]
        value, vector = np.linalg.eigh(np.eye(len(lost)) - lost @ lost.T)
        inverse = (vector / value) @ vector.T if value.min(initial=1.0) > SEEN_MIN else None
        found.append(SeenAlike(np.flatnonzero(which.ravel() == number), lost, inverse))
    return found


def variance_at_points(design: Design, seen: Bools) -> Floats:
    """(p, P) variance of the coefficients of each point, for responses of unit variance, from the maps `seen` (M, P)
    that have data there; infinite where these do not determine the unknowns.
    """
    loading = np.linalg.inv(design.basis.T @ design.matrix)
    found = np.full((len(loading), seen.shape[1]), np.inf)
    for at, lost, inverse in seen_alike(design, seen):
        if inverse is not None:
            along = lost @ loading.T
            found[:, at] = (np.square(loading).sum(axis=1) + (along * (inverse @ along)).sum(axis=0))[:, None]
    return found


def regress(design: Design, maps: MapSet) -> tuple[Regression, Floats]:
    """Regress coefficients and sag together; points without data are filled from the fit, round by round.

    Each point is fitted to the maps with data there; rounds are needed because piston and tilt of a map depend on its
    filled points. If those maps do not determine the unknowns, filled values take part in the fit, as in the
    expectation-maximisation form of least squares with missing data; they start from the terms of the maps.

    Returns:
        The regression, and its responses (M, K + P): coefficients, and sag without gaps, piston and tilt, m.
    """
    sag = remove_piston_tilt(maps.sag, maps.points)
    gaps = np.isnan(sag).any(axis=1)
    filled = sag.copy()
    if gaps.any():
        modes = basis(maps.points.x, maps.points.y)
        model = weighted_fit(sag[gaps], modes, maps.points.weight) @ modes.T
        projection, seen = design.basis, np.isfinite(sag)
        alike = seen_alike(design, seen)
        for _ in range(GAP_ROUNDS):
            before = filled[gaps]
            filled[gaps] = fill_gaps(sag[gaps], model, maps.points)
            if np.abs(filled[gaps] - before).max(initial=0.0) < GAP_TOLERANCE:  # NaN in the first round
                break
            solution = projection.T @ filled
            data = projection.T @ np.where(seen, filled, 0.0)
            for at, lost, inverse in alike:
                if inverse is not None:
                    solution[:, at] = data[:, at] + lost.T @ (inverse @ (lost @ data[:, at]))
            model = projection[gaps] @ solution
    responses = np.hstack((maps.coefficients, filled))
    return least_squares(design, responses), responses
