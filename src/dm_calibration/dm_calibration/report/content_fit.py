"""Text of the report, part two: influence functions, actuators, residuals, regions, coefficients."""

from dataclasses import replace

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import effective_maps
from dm_calibration.hysteresis.run import basis_of, without
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_NAMES
from dm_calibration.influence.regression import make_design
from dm_calibration.report import figures
from dm_calibration.report.content import NM
from dm_calibration.report.document import Picture, Section, Table
from dm_common.geometry import rings
from dm_common.optics.piston_tilt import fill_gaps, remove_piston_tilt
from dm_common.optics.sample_regions import AREA_FRACTIONS, EmptyRegionError, regional_rms
from dm_common.optics.zernike import NAMES, PISTON_TILT


def residuals(calibration: Calibration) -> MapSet:
    """The maps used in the fit, with the residuals of their sag (0 where a map has no data) and coefficients, m.

    A residual is the measured value less influence function times signals less the drifting figure, without piston and
    tilt; `applied` contains effective signals if there is a hysteresis model. The figure is recomputed from the
    residuals: for a given influence function, its values at the reference frames solve the same least-squares problem.

    Raises:
        TooFewMapsError, ValueError: maps that do not allow a fit, which those of a stored calibration do.
    """
    fit, maps = calibration.fit, calibration.maps
    if calibration.hysteresis is not None:
        maps = effective_maps(maps, calibration.hysteresis.law)
    used = maps.select(fit.used)
    design = make_design(used)
    drift = basis_of(design.matrix[:, : design.drift])
    predicted = used.applied @ fit.influence_sag.T + fit.sag_offset
    sag = fill_gaps(remove_piston_tilt(used.sag, used.points), predicted, used.points) - predicted
    sag = np.where(np.isfinite(used.sag), sag, 0.0)
    coefficients = used.coefficients - used.applied @ fit.influence_zernike.T - fit.zernike_offset
    return replace(used, sag=without(sag, drift), coefficients=without(coefficients, drift))


def influence(calibration: Calibration) -> Section:
    """The influence functions and the actuators' grades."""
    fit = calibration.fit
    ring = rings(calibration.actuator_x, calibration.actuator_y)
    rows = [
        (
            str(k + 1),
            f"{calibration.actuator_x[k] * 1e3:+.2f}",
            f"{calibration.actuator_y[k] * 1e3:+.2f}",
            str(ring[k]),
            f"{fit.response[k] * NM:.1f}",
            f"{fit.standard_error[k] * NM:.2f}",
            GRADE_NAMES[fit.grades[k]],
        )
        for k in range(fit.actuators)
    ]
    text = (
        f"The maps of the second page are interpolated between the {fit.points.x.size} sampling points. The response "
        "is the rms of such a map. An actuator is weak or dead when its response is small beside its ring's median or "
        "not well above its standard error."
    )
    header = ("actuator", "x, mm", "y, mm", "ring", "response, nm", "± nm", "grade")
    return Section("Influence functions", [text], [Table("Actuators", header, rows)])


def residual(calibration: Calibration) -> Section:
    """Residual of each map."""
    text = "Reference frames are maps at mid range; the figure of the mirror is followed from one to the next."
    drawn = figures.residual_figure(calibration)
    picture = Picture("residuals", "What the fit leaves of each map, over the run.", drawn)
    return Section("Residuals of the maps", [text], pictures=[picture])


def regions(calibration: Calibration, left: MapSet) -> Section:
    """Residual by region."""
    title = "Regions"
    try:
        regional = regional_rms(left.sag, left.points, labels=left.label)
    except EmptyRegionError as error:
        return Section(title, [f"Not evaluated: {error}."])
    moved = ~left.reference
    shown, kinds = regional[moved], [kind for kind, each in zip(left.kind, moved, strict=True) if each]
    weights = calibration.region_weights
    header = ["area, %", "median, nm", "90th percentile, nm", "largest, nm"] + (["weight"] if weights.size else [])
    rows = []
    for k, share in enumerate(AREA_FRACTIONS):
        column = shown[:, k] * NM
        row = [f"{share:.0%}", *(f"{value:.2f}" for value in (*np.quantile(column, (0.5, 0.9)), column.max()))]
        rows.append(row + ([f"{weights[k]:.3f}"] if weights.size else []))
    text = (
        "rms of the residual inside concentric discs of 10 … 100 % of the aperture's area, over all maps but the "
        "reference frames, in-sample."
    )
    if weights.size:
        text += (
            " The weights are those of Eq. (8), from the variance of the surface control error over the sample "
            "surfaces; a controller may weight its command by them."
        )
    picture = Picture("regions", "Residual inside each disc: one dot per map.", figures.regions_figure(shown, kinds))
    return Section(title, [text], [Table("Residual by region", header, rows)], [picture])


def coefficients(calibration: Calibration, left: MapSet) -> Section:
    """Residual by Zernike term."""
    hysteresis = calibration.hysteresis
    sigma = hysteresis.zernike_sigma if hysteresis is not None else None
    rms = np.sqrt(np.mean(np.square(left.coefficients), axis=0))
    header = ["term", "in-sample rms, nm"] + (["held-out moves, nm"] if sigma is not None else [])
    rows = [
        [NAMES[k], f"{rms[k] * NM:.3f}"] + ([f"{sigma[k] * NM:.3f}"] if sigma is not None else [])
        for k in range(PISTON_TILT, left.terms)
    ]
    text = "What the fit leaves of each coefficient beyond tilt, rms over the maps. "
    if sigma is not None:
        text += (
            "Held-out moves are those of the check, predicted by a law not fitted to them; the noise of their maps is "
            "subtracted, so they can lie below the in-sample figure."
        )
    picture = Picture("coefficients", "Error of each coefficient.", figures.coefficients_figure(rms, sigma))
    return Section("Zernike coefficients", [text], [Table("Residual by coefficient", header, rows)], [picture])
