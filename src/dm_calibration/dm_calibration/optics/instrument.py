"""Errors of the instrument that depend on tilt or position: retrace error and radial distortion.

Both are corrected in the map as the camera shows it, in camera coordinates: from the centre of the map, y up, in units
of half its longer side.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from dm_calibration.optics.map_fit import MapFitter, in_products
from dm_calibration.optics.orientation import resampled
from dm_common import Floats
from dm_common.optics.piston_tilt import fit_plane
from dm_common.optics.zernike import MAX_ORDER, PISTON_TILT, TERMS

#: Number of retrace coefficients: the terms beyond tilt for a tilt in x, then for a tilt in y.
RETRACE_SIZE = 2 * (len(TERMS) - PISTON_TILT)
#: Least spread, in each direction, of the tilts from which retrace error is found, m at the edge.
TILT_MIN = 1e-7
#: Largest difference of a coefficient between maps of one shape after correction of their retrace error, m.
LEFT_MAX = 3e-8
#: Largest share of the difference before correction that may remain, but never less than the noise of maps, m.
LEFT_SHARE, LEFT_NOISE = 0.3, 3e-9
#: Fewest maps, and fewest points of a grid: enough for residuals that show the quality of the result.
MAPS_MIN, POINTS_MIN = 5, 8
#: Condition of a derivative by differences from which on its columns count as dependent.
CONDITION_MAX = 1e6
#: A grid is refused if its bound on scale or distortion reaches this value, the largest that the node accepts.
UNCERTAIN_MAX = 0.1


def _axes(shape: tuple[int, ...]) -> tuple[Floats, Floats, float]:
    """x of the columns, y of the rows, and half the longer side in pixels."""
    half = 0.5 * max(shape)
    y, x = (np.asarray(np.arange(size) - 0.5 * (size - 1), dtype=np.float64) / half for size in shape)
    return x, -y, half


def _tilt(sag: Floats) -> Floats:
    """(2,) m, sag at the edge of the camera due to tilt, in x and y."""
    _, in_columns, in_rows = fit_plane(sag)
    return np.array((in_columns, -in_rows)) * 0.5 * max(sag.shape)


def without_retrace(sag: Floats, retrace: ArrayLike) -> Floats:
    """(height, width) m, the map less the error that is proportional to its tilt.

    Args:
        retrace: (36,) coefficients of the 18 terms beyond tilt per m of sag at the edge by tilt in x, then in y.
    """
    if not np.isfinite(sag).any():  # without data there is no tilt
        return sag
    x, y, _ = _axes(sag.shape)
    added = np.zeros(len(TERMS))
    added[PISTON_TILT:] = _tilt(sag) @ np.asarray(retrace).reshape(2, -1)
    polynomial = in_products(added)
    return np.asarray(sag - legendre.legvander(y, MAX_ORDER) @ polynomial @ legendre.legvander(x, MAX_ORDER).T)


def find_retrace(maps: Sequence[Floats]) -> tuple[Floats, float, float]:
    """Retrace error from maps (height, width), m, of one shape under different tilts.

    Returns:
        The (36,) numbers of :func:`without_retrace`, and the largest deviation of a coefficient, m: from the mean of
        the maps, and after correction.

    Raises:
        ValueError: too few maps, maps of different sizes or shapes, or tilts that do not differ in both directions.
        InsufficientDataError: a map with too few valid pixels for the terms.
    """
    if len(maps) < MAPS_MIN or len({sag.shape for sag in maps}) > 1:
        sizes = sorted({"{1} x {0}".format(*sag.shape) for sag in maps})
        raise ValueError(f"{len(maps)} maps of {', '.join(sizes)} pixels: must be {MAPS_MIN} or more of one size")
    height, width = maps[0].shape
    circle = 0.5 * (width - 1), 0.5 * (height - 1), 0.5 * max(height, width)
    fits = [MapFitter(np.isfinite(sag), *circle).fit(sag).coefficients for sag in maps]
    terms = np.array(fits)[:, PISTON_TILT:]
    tilt = np.array([_tilt(sag) for sag in maps])
    spread = np.linalg.svd(tilt - tilt.mean(axis=0), compute_uv=False)[-1]
    if spread < TILT_MIN:
        raise ValueError(
            f"the tilts differ by {spread * 1e9:.0f} nm in one direction: must be {TILT_MIN * 1e9:.0f} nm at the edge "
            "or more; tilt in x and in y, by some fringes"
        )
    design = np.column_stack((np.ones(len(maps)), tilt))
    solution = np.linalg.lstsq(design, terms, rcond=None)[0]
    before, left = (float(np.abs(terms - mean).max()) for mean in (terms.mean(axis=0), design @ solution))
    most = min(max(LEFT_SHARE * before, LEFT_NOISE), LEFT_MAX)
    if left > most:
        tilts = "smaller" if most == LEFT_MAX else "larger"
        raise ValueError(
            f"coefficients differ by up to {left * 1e9:.1f} nm that tilt does not explain: must be {most * 1e9:.1f} "
            f"nm or less; take maps of one shape, with {tilts} tilts, or average them"
        )
    return solution[1:].ravel(), before, left


def undistorted(sag: Floats, distortion: float) -> Floats:
    """(height, width) the map without radial distortion, which shows points at the distance r from the centre (1 at the
    edge) further out by the share `distortion` * r**2.
    """
    from scipy import ndimage  # imported here: most benches need no correction

    x, y, half = _axes(sag.shape)
    stretch = 1.0 + distortion * np.add.outer(y**2, x**2)
    rows = 0.5 * (sag.shape[0] - 1) - y[:, None] * stretch * half
    columns = 0.5 * (sag.shape[1] - 1) + x * stretch * half
    return resampled(sag, lambda values: ndimage.map_coordinates(values, (rows, columns), order=1))


@dataclass(frozen=True)
class LateralScale:
    """Result from a grid: m per pixel at the centre of the map, distortion at its edge as a share of the distance, 95 %
    bounds on the relative error of the pitch and on the error of the distortion, and the rms residual distance, m.
    """

    pitch: float
    distortion: float
    scale_error: float
    distortion_error: float
    left: float


def lateral_scale(marks: ArrayLike, shape: tuple[int, ...]) -> LateralScale:
    """Lateral scale and distortion from a grid of marks.

    Args:
        marks: (G, 4) for each mark, the column and row at which it is seen, pixels, and its true x and y, m.
        shape: (height, width) of the maps.

    Raises:
        ValueError: too few marks, or all on one line.
    """
    half = 0.5 * max(shape)
    column, row, x, y = np.asarray(marks, dtype=np.float64).reshape(-1, 4).T
    seen = np.asarray((column - 0.5 * (shape[1] - 1) + 1j * (0.5 * (shape[0] - 1) - row)) / half, dtype=np.complex128)
    ranks = (
        np.linalg.matrix_rank(np.column_stack((np.ones(len(x)), *place)), 1e-9)
        for place in ((x, y), (seen.real, seen.imag))
    )
    if len(seen) < POINTS_MIN or min(ranks) < 3:
        raise ValueError(f"{len(seen)} marks: must be {POINTS_MIN} or more, and not all on one line")
    fits = [_similarity(seen, place) for place in (x + 1j * y, -x + 1j * y)]  # the camera may show it mirrored
    values, covariance, left = min(fits, key=lambda fit: fit[2])
    size = float(np.hypot(values[0], values[1]))
    along = values[:2] / size
    with np.errstate(invalid="ignore"):
        bounds = 2.0 * np.sqrt((along @ covariance[:2, :2] @ along / size**2, covariance[4, 4]))
    if not bounds.max() < UNCERTAIN_MAX:  # NaN too
        text = "the marks do not separate scale from distortion: must be exact, at different distances from the middle"
        raise ValueError(text)
    return LateralScale(size / half, float(values[4]), float(bounds[0]), float(bounds[1]), left)


def _similarity(seen: NDArray[np.complex128], place: NDArray[np.complex128]) -> tuple[Floats, Floats, float]:
    """(5,) complex scale, complex shift and distortion that map `seen` (camera coordinates) to `place` (m), their
    covariance, and the rms residual distance, m.
    """
    from scipy.optimize import least_squares

    size = np.abs(place - place.mean()).max()

    def apart(values: Floats) -> Floats:
        true = seen.copy()
        for _ in range(5):
            true = seen / (1.0 + values[4] * np.abs(true) ** 2)
        left = (complex(*values[:2]) * true + complex(*values[2:4])) * size - place
        return np.concatenate((left.real, left.imag))

    found = least_squares(apart, (1.0, 0.0, 0.0, 0.0, 0.0))
    variance = 2.0 * found.cost / (2 * len(seen) - 5)
    unit = np.array((size, size, size, size, 1.0))
    covariance = np.full((5, 5), np.inf)
    if np.linalg.cond(found.jac) < CONDITION_MAX:
        covariance = variance * np.linalg.inv(found.jac.T @ found.jac) * np.outer(unit, unit)
    return found.x * unit, covariance, float(np.sqrt(2.0 * found.cost / len(seen)))
