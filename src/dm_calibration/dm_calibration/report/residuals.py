"""What a calibration's fit leaves unexplained in the maps it was made from, point by point and term by term."""

from dataclasses import dataclass

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import effective_maps
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.regression import make_design
from dm_common import Floats
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt


@dataclass(frozen=True, eq=False)
class Residuals:
    """U maps that entered the fit.

    Attributes:
        maps: those maps; `applied` are effective signals where the calibration holds a hysteresis model.
        sag: (U, P) m, piston and tilt removed; 0 where a map has no data.
        coefficients: (U, K) m.
    """

    maps: MapSet
    sag: Floats
    coefficients: Floats


def residuals(calibration: Calibration) -> Residuals:
    """The residuals of the fit: measured less influence function times signals less the figure as it drifted.

    The figure is found again from the residuals: with the influence function given, its values at the reference frames
    are the same least-squares problem as in the fit.

    Raises:
        TooFewMapsError, ValueError: maps that no fit can be made of; those of a stored calibration can.
    """
    fit, maps = calibration.fit, calibration.maps
    if calibration.hysteresis is not None:
        maps = effective_maps(maps, calibration.hysteresis.law)
    used = maps.select(fit.used)
    design = make_design(used)
    drift = design.matrix[:, : design.drift]
    predicted = used.applied @ fit.influence_sag.T + fit.sag_offset
    sag = fill_gaps(remove_piston_tilt(used.sag, used.points), predicted, used.points) - predicted
    sag = np.where(np.isfinite(used.sag), sag, 0.0)
    coefficients = used.coefficients - used.applied @ fit.influence_zernike.T - fit.zernike_offset
    return Residuals(used, _less(drift, sag), _less(drift, coefficients))


def _less(columns: Floats, values: Floats) -> Floats:
    """`values` (U, Q) less their least-squares fit by `columns` (U, R)."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])
