"""Concentric circular regions of the aperture (Fig. 4 in [1]) and the errors inside them (Fig. 5)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from dm_calibration.optics.aperture import Aperture
from dm_calibration.optics.map_fit import in_products
from dm_common.optics.piston_tilt import weighted_fit
from dm_common.optics.sample_regions import AREA_FRACTIONS, check_regions, disc_shares
from dm_common.optics.sampling import SamplePoints
from dm_common.optics.zernike import MAX_ORDER

#: Surfaces that are left out of the mean of Fig. 5(b) in [1]: Z_2^0 and Z_2^2.
OUTSIDE_MEAN = ("pz02", "pz03")
#: Pixels of the blocks in which a map is processed: 0.5 MB.
_BLOCK_PIXELS = 2**16


def checked_fractions(area_fractions: ArrayLike) -> NDArray[np.float64]:
    """(R,) shares of the area as an array; ValueError unless they increase, from above 0 to at most 1."""
    fractions = np.asarray(area_fractions, dtype=float)
    if not (fractions.size and (np.diff(fractions) > 0).all() and fractions[0] > 0 and fractions[-1] <= 1):
        raise ValueError(f"area_fractions = {fractions.tolist()}: must rise within 0 to 1")
    return fractions


def levelled_rms(sag: NDArray[np.float64], points: SamplePoints) -> NDArray[np.float64]:
    """(M, R) rms of samples (M, P) inside each concentric disc about its own best plane.

    [1] does not say whether a partial aperture is levelled on its own, as an interferometer with that aperture would
    show it; `dm_common.optics.sample_regions.regional_rms` is the other reading.
    """
    plane = np.column_stack((np.ones_like(points.x), points.x, points.y))
    seen = np.isfinite(sag)
    levelled = []
    for share in (points.weight[:, np.newaxis] * disc_shares(points)).T:
        rest = np.where(seen, np.square(sag - weighted_fit(sag, plane, share) @ plane.T), 0.0)
        levelled.append(np.sqrt(rest @ share / (seen @ share)))
    return np.column_stack(levelled)


def squared_distance(aperture: Aperture, shape: tuple[int, int]) -> NDArray[np.float64]:
    """(height, width): squared distance of each pixel from the centre, in units of the radius."""
    x = (np.arange(shape[1]) - aperture.centre_x_px) / aperture.radius_px
    y = (np.arange(shape[0]) - aperture.centre_y_px) / aperture.radius_px
    return np.asarray(x**2 + y[:, None] ** 2)


def residual_map(
    sag: NDArray[np.float64], coefficients: NDArray[np.float64], aperture: Aperture
) -> NDArray[np.float64]:
    """(height, width) the map minus the sag of its Zernike coefficients (21,); NaN outside the aperture."""
    height, width = sag.shape
    x = (np.arange(width) - aperture.centre_x_px) / aperture.radius_px
    y = (aperture.centre_y_px - np.arange(height)) / aperture.radius_px
    terms = legendre.legvander(y, MAX_ORDER) @ in_products(coefficients) @ legendre.legvander(x, MAX_ORDER).T
    return np.where(aperture.disc(sag.shape), sag - terms, np.nan)


def row_spans(
    aperture: Aperture, shape: tuple[int, int], area_fraction: float = 1.0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First column and column after the last of the pixels inside, for each row of a map.

    The same pixels as ``squared_distance(aperture, shape) <= area_fraction``, without visiting each: the square root is
    only a first guess, which the same comparison corrects among the neighbouring columns.

    Args:
        area_fraction: of the concentric disc.

    Returns:
        Two of (height,); equal where a row has no pixel inside.
    """
    y2 = ((np.arange(shape[0]) - aperture.centre_y_px) / aperture.radius_px) ** 2
    half = aperture.radius_px * np.sqrt(np.maximum(area_fraction - y2, 0.0))
    beside = np.arange(-2, 3)
    left = np.ceil(aperture.centre_x_px - half)[:, None] + beside
    right = np.floor(aperture.centre_x_px + half)[:, None] - beside

    def inside(column: NDArray[np.float64]) -> NDArray[np.bool_]:
        return ((column - aperture.centre_x_px) / aperture.radius_px) ** 2 + y2[:, None] <= area_fraction

    rows = np.arange(shape[0])
    found = inside(left)
    start = left[rows, found.argmax(axis=1)]
    end = np.where(found.any(axis=1), right[rows, inside(right).argmax(axis=1)] + 1, start)
    return np.clip(start, 0, shape[1]).astype(np.intp), np.clip(end, 0, shape[1]).astype(np.intp)


class ConcentricRegions:
    """Concentric discs with given shares of the aperture's area, for maps of one shape and aperture."""

    def __init__(self, shape: tuple[int, int], aperture: Aperture, area_fractions: ArrayLike = AREA_FRACTIONS) -> None:
        """Find the region of every pixel.

        Args:
            shape: (height, width) of the maps.
            area_fractions: (R,) rising, above 0 and at most 1.

        Raises:
            ValueError: fractions out of range or order.
        """
        fractions = checked_fractions(area_fractions)
        self.area_fractions = fractions
        self._shape = shape
        # Every row meets a disc in one run of pixels. Together the ends of these runs cut the row into pieces, each of
        # which belongs to one ring between two discs; a sum over a piece is one step of `reduceat`.
        spans = [row_spans(aperture, shape, fraction) for fraction in fractions]
        rings = len(spans)
        columns = np.stack([start for start, _end in spans[::-1]] + [end for _start, end in spans], axis=1)
        for k in range(1, rings):  # rows that miss an inner disc: its empty run must lie inside the next larger one
            columns[:, rings + k - 1] = np.minimum(columns[:, rings + k - 1], columns[:, rings + k])
        columns = np.maximum.accumulate(columns, axis=1)
        ring = np.concatenate([np.arange(rings)[::-1], np.arange(1, rings + 1)])
        # Blocks of rows, so that the intermediate arrays of a block stay in the processor's cache.
        size = max(_BLOCK_PIXELS // shape[1], 1)
        self._blocks = [
            (slice(start, start + size), *_pieces(columns[start : start + size], ring, shape[1]))
            for start in range(0, shape[0], size)
        ]

    def rms(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Root mean square (about zero) of a residual map inside each disc, in one pass over the map.

        Args:
            residual: (height, width), NaN = no data.

        Returns:
            (R,), in the unit of the residual; NaN for a disc without valid pixels.
        """
        size = len(self.area_fractions) + 1
        energy, count = np.zeros(size), np.zeros(size)
        for rows, pieces, ring in self._blocks:
            if pieces.size:
                valid = np.isfinite(residual[rows])
                squares = np.square(residual[rows])
                squares[~valid] = 0.0
                energy += np.bincount(ring, np.add.reduceat(squares.ravel(), pieces), size)
                valid_pixels = np.add.reduceat(valid.view(np.uint8).ravel(), pieces, dtype=np.int64)
                count += np.bincount(ring, valid_pixels, size)
        with np.errstate(invalid="ignore"):
            return np.sqrt(energy[:-1].cumsum() / count[:-1].cumsum())

    def rms_of_each(self, residuals: Iterable[NDArray[np.float64]], labels: Sequence[str] = ()) -> NDArray[np.float64]:
        """:meth:`rms` of a set of residual maps, one pass over each, one map in memory at a time.

        Args:
            residuals: M maps (height, width), NaN = no data; may be a generator.
            labels: names of the maps for messages; "map 1", "map 2", ... when there are fewer than maps.

        Returns:
            (M, R), in the unit of the residuals; all finite.

        Raises:
            EmptyRegionError: a disc of some map holds no valid pixel.
            ValueError: a map of another shape, or no map at all.
        """
        rows = []
        for number, residual in enumerate(residuals):
            label = labels[number] if number < len(labels) else f"map {number + 1}"
            if residual.shape != self._shape:
                raise ValueError(
                    f"{label} has the shape {residual.shape}, the regions were made for {self._shape}: "
                    "compare only maps of one camera and one aperture"
                )
            rows.append(self.rms(residual))
            check_regions(rows[-1][np.newaxis], self.area_fractions, (label,))
        if not rows:
            raise ValueError("no map given: regional errors need at least one")
        return np.stack(rows)


@dataclass(frozen=True, eq=False)
class RegionStatistics:
    """One panel of Fig. 5: regional rms errors over a group of surfaces.

    Attributes:
        labels: (M,) of the surfaces, the dots of the figure.
        rms: (M, R) m.
        averaged: (M,) which of them enter mean and variance.
        area_fractions: (R,) shares of the aperture's area.
        mean: (R,) m, the polyline of the figure.
        variance: (R,) m^2, unbiased (divisor: surfaces - 1).
    """

    labels: tuple[str, ...]
    rms: NDArray[np.float64]
    averaged: NDArray[np.bool_]
    area_fractions: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


def region_statistics(
    rms: NDArray[np.float64],
    labels: Sequence[str] = (),
    leave_out: Collection[str] = (),
    area_fractions: ArrayLike = AREA_FRACTIONS,
) -> RegionStatistics:
    """Mean and variance over surfaces of regional errors.

    Args:
        rms: (M, R) m, one row per surface.
        labels: (M,); "map 1", ... when empty.
        leave_out: labels that count as dots only.

    Raises:
        EmptyRegionError: a NaN in `rms`.
        ValueError: fewer than two surfaces to average, or lengths that disagree.
    """
    fractions = checked_fractions(area_fractions)
    names = tuple(labels) or tuple(f"map {k + 1}" for k in range(len(rms)))
    if rms.ndim != 2 or rms.shape != (len(names), len(fractions)):
        raise ValueError(f"rms has the shape {rms.shape}: must be ({len(names)} surfaces, {len(fractions)} regions)")
    check_regions(rms, fractions, names)
    averaged = np.array([name not in leave_out for name in names], dtype=bool)
    if averaged.sum() < 2:
        raise ValueError(f"{averaged.sum()} surfaces to average: a variance needs at least 2, measure more surfaces")
    chosen = rms[averaged]
    return RegionStatistics(names, rms, averaged, fractions, chosen.mean(axis=0), chosen.var(axis=0, ddof=1))


def figure_5(rms: NDArray[np.float64], labels: Sequence[str]) -> tuple[RegionStatistics, RegionStatistics]:
    """Both panels of Fig. 5: (a) the actuator surfaces p01-p58, (b) the Zernike surfaces, averaged without pz02, pz03.

    Args:
        rms: (M, 10) m, one row per surface; rows that are neither (reference frames, pokes) are left out.
        labels: (M,) names as in Table 1.

    Raises:
        ValueError: a panel has fewer than two surfaces to average; otherwise as :func:`region_statistics`.
    """
    if len(rms) != len(labels):
        raise ValueError(f"{len(rms)} rows of errors for {len(labels)} labels: must be equal")
    panels = []
    for prefix, leave_out in (("p", ()), ("pz", OUTSIDE_MEAN)):
        rows = [k for k, name in enumerate(labels) if name.removeprefix(prefix).isdigit() and name.startswith(prefix)]
        panels.append(region_statistics(rms[rows], [labels[k] for k in rows], leave_out))
    return panels[0], panels[1]


def _pieces(columns: NDArray[np.intp], ring: NDArray[np.intp], width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Flat index where each piece of some rows begins, and its ring; pieces without a pixel left out.

    Args:
        columns: (rows, 2 R), rising along each row: where the pieces begin.
        ring: (2 R,) of the pieces of a row.
    """
    begin = (np.arange(len(columns))[:, None] * width + columns).ravel()
    filled = np.diff(begin, append=len(columns) * width) > 0
    return begin[filled], np.tile(ring, len(columns))[filled]
