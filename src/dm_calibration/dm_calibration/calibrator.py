"""From the maps of a run, or of a stored calibration, to a calibration: fit, poke check, limitations in words."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dm_calibration.calibration import Calibration, software_version
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, effective_maps, fit_hysteresis
from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.influence.maps import EXCITATION, SURFACE, MapSet
from dm_calibration.influence.poke_check import PokeCheck, check_pokes
from dm_calibration.influence.quality import GRADE_DEAD, GRADE_NOT_EXCITED
from dm_calibration.influence.region_weighting import weighting_of
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.procedure import Outcome
from dm_common.mirror import Mirror

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Provenance:
    """Where a calibration comes from: its id, time (ns), the user's note."""

    id: str
    created_ns: int
    note: str = ""


def check_fit(fit: InfluenceFit, mirror: Mirror) -> PokeCheck:
    """Poke check of the responses in `fit` against the layout of `mirror`."""
    return check_pokes(
        fit.influence_sag,
        fit.points,
        mirror.x / mirror.working_radius,
        mirror.y / mirror.working_radius,
        silent=fit.grades == GRADE_DEAD,
        unmoved=fit.grades == GRADE_NOT_EXCITED,
    )


def evaluate(
    outcome: Outcome, mirror: Mirror, options: FitOptions, provenance: Provenance, run_limitations: Collection[str] = ()
) -> tuple[Calibration, PokeCheck]:
    """Fit the maps of a run and compare the responses with the layout; where it holds excitation, the memory first.

    Raises:
        TooFewMapsError: the good maps do not determine the unknowns, or do not show the memory.
        ValueError: time stamps that run backwards where the memory is to be identified.
    """
    maps = outcome.maps()
    hysteresis = fit_hysteresis(maps) if EXCITATION in maps.kind else None
    fit = fit_remembering(maps, hysteresis, options, mirror)
    check = check_fit(fit, mirror)
    limitations = [*fit.limitations, *(hysteresis.remarks if hysteresis else ()), *run_limitations]
    if not outcome.radius_known:
        limitations.append(
            "The maps do not tell their aperture radius; the mirror's working aperture "
            f"({mirror.working_radius * 1e3:.2f} mm radius) is taken."
        )
    if outcome.wavelength == 0.0:
        limitations.append("The maps do not tell their wavelength.")
    if (parts := np.unique(maps.segment).size) > 1:
        limitations.append(f"Measured in {parts} parts: the run was interrupted and resumed.")
    limitations += [f"Poke check: {finding}." for finding in check.findings]
    limitations += [f"Measured differently: {remark}." for remark in outcome.remarks]
    calibration = Calibration(
        id=provenance.id,
        mirror_name=mirror.name,
        mirror_serial=mirror.serial,
        wavelength=outcome.wavelength,
        aperture_radius=mirror.working_radius,
        created_ns=provenance.created_ns,
        actuator_x=mirror.x,
        actuator_y=mirror.y,
        maps=maps,
        fit=fit,
        dropped=tuple(outcome.dropped),
        targets=tuple(outcome.targets),
        limitations=tuple(limitations),
        note=provenance.note,
        software_version=software_version(),
        hysteresis=hysteresis,
        region_weights=_region_weights(maps, fit, options),
    )
    return calibration, check


def _region_weights(maps: MapSet, fit: InfluenceFit, options: FitOptions) -> Floats:
    """(10,) weights for commands weighted by region; empty where the maps give none."""
    if SURFACE not in maps.kind:
        return np.zeros(0)
    try:
        return weighting_of(maps, fit.used, options.folds, options.epsilon).weights
    except (TooFewMapsError, ValueError):  # a calibration is whole without them
        return np.zeros(0)


def fit_remembering(
    maps: MapSet, hysteresis: HysteresisFit | None, options: FitOptions, mirror: Mirror, exclude: Collection[str] = ()
) -> InfluenceFit:
    """The influence function of `maps`, of effective signals when a memory is known.

    Raises:
        As :func:`~dm_calibration.influence.fit.fit_influence`.
    """
    if hysteresis is None:
        return fit_influence(maps, options, rings=mirror.rings, exclude=exclude)
    fit = fit_influence(effective_maps(maps, hysteresis.law), options, rings=mirror.rings, exclude=exclude)
    return replace(fit, signal_min=float(maps.applied.min()), signal_max=float(maps.applied.max()))


def refit(stored: Calibration, options: FitOptions, exclude: Collection[str], provenance: Provenance) -> Calibration:
    """A new calibration from the raw data of `stored`, without the maps in `exclude`.

    Raises:
        UnknownNameError: an unknown method or label.
        TooFewMapsError: the maps left do not determine the unknowns.
    """
    mirror = Mirror(
        stored.mirror_name, stored.mirror_serial, stored.actuator_x, stored.actuator_y, stored.aperture_radius
    )
    fit = fit_remembering(stored.maps, stored.hysteresis, options, mirror, exclude)
    of_the_run = [sentence for sentence in stored.limitations if sentence not in stored.fit.limitations]
    without = f" without {', '.join(exclude)}" if exclude else ""
    return replace(
        stored,
        id=provenance.id,
        created_ns=provenance.created_ns,
        fit=fit,
        region_weights=_region_weights(stored.maps, fit, options),
        limitations=(*fit.limitations, *of_the_run, f"Fitted again from the raw data of {stored.id}{without}."),
        note=provenance.note or stored.note,
        software_version=software_version(),
    )


def dropped_maps(maps: MapSet, fit: InfluenceFit, never_measured: Collection[str]) -> list[str]:
    """ "label: reason" of everything that is not in the fit."""
    rejected = [f"{maps.label[i]}: {fit.reasons[i]}" for i in np.flatnonzero(~fit.used)]
    return [*never_measured, *rejected]
