"""Make a calibration from maps or from a stored calibration: fit, poke check, limitations as sentences."""

import time
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dm_calibration.acquisition.ingest import IngestSettings
from dm_calibration.acquisition.map_sources import Maps, outcome_of, unix_times
from dm_calibration.calibration import POKE_CHECK, Calibration, software_version
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, effective_maps, fit_hysteresis
from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.poke_check import PokeCheck, check_pokes
from dm_calibration.influence.quality import GRADE_DEAD, GRADE_NOT_EXCITED
from dm_calibration.influence.region_weighting import weighting_of
from dm_calibration.influence.screening import LAW_ERRORS
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.recalibration.not_followed import NOT_FOLLOWED, not_followed
from dm_calibration.store.calibration_store import new_id
from dm_common import Floats
from dm_common.mirror import Mirror

#: Fields on the instrument that a calibration takes over from the setup of its run.
_INSTRUMENT = ("system_error_subtracted", "reference_surface", "instrument_error", "scale_error")


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
        mirror.x,
        mirror.y,
        mirror.working_radius,
        silent=fit.grades == GRADE_DEAD,
        unmoved=fit.grades == GRADE_NOT_EXCITED,
    )


def calibrate(
    maps: Maps | Outcome,
    commands: ArrayLike | None = None,
    times: ArrayLike | None = None,
    *,
    moved: ArrayLike | None = None,
    mirror: Mirror,
    options: FitOptions | None = None,
    settings: IngestSettings | None = None,
    hysteresis: bool = False,
    provenance: Provenance | None = None,
    run_limitations: Collection[str] = (),
) -> Calibration:
    """Make a calibration: influence function, hysteresis model where the maps show it, poke check, limitations.

    The node `calibration` calls this with what its run has measured; a notebook needs no ROS::

        from dm_calibration import calibrate
        calibration = calibrate("maps/", commands, mirror=mirror)

    Parameters
    ----------
    maps
        A folder of map files, a list of map files, sag as an array (M, height, width) in m (NaN = no data; give
        ``settings`` with the pitch), a list of :class:`~dm_common.measurement.Measurement`, or the
        :class:`~dm_calibration.procedure.outcome.Outcome` of a run, which holds its commands and all times.
    commands : array_like (M, N)
        Normalised signals applied to the mirror, one row for each map.
    times : array_like (M,), optional
        When the maps were taken, s, in Unix time, or from another start (the last map is then dated now). By default as
        given in the files, some of which have whole seconds only. Required for hysteresis.
    moved : array_like (M,), optional
        When the mirror took each shape, on the clock of ``times``; by default right after the map before. Give it if
        time passed in between, e.g. to save a map: otherwise creep is found wrong, which held-out errors hardly show.
    mirror
        Positions of the actuators, working aperture and limits.
    options
        Method and thresholds of the fit.
    settings
        Pitch, orientation and aperture of the maps; by default the mirror's aperture in the centre of each map.
    hysteresis
        Whether to identify hysteresis and creep. The commands must begin after a degauss: some hundred random shapes
        (see :func:`~dm_calibration.hysteresis.excitation.excitation`). The last fifth of the maps tests the model.
    provenance
        Id, time and note; by default an id from the mirror's names and the time, now, and no note.
    run_limitations
        Sentences to add to those of the result.

    Returns
    -------
    Calibration
        Store it with :class:`~dm_calibration.store.calibration_store.CalibrationStore`.

    Raises
    ------
    MapFileError, MapRejectedError, InsufficientDataError
        A file or array is unusable. With ``hysteresis``, a map with too few data is left out, but its command counts.
    MeasurementError
        A map cannot be compared with those before it.
    Refusal
        A value of ``settings`` is not allowed; the message names it.
    TooFewMapsError
        The good maps do not determine the unknowns, or do not show hysteresis.
    ValueError
        Commands or times that do not match the maps, or commands that are not normalised; for hysteresis, times that
        are missing, equal for maps of two commands, or run backwards; or a time in ``moved`` that is not between the
        map before and its own.
    """
    if isinstance(maps, Outcome):
        outcome = maps
    elif commands is None:
        raise ValueError("commands: must be given, (M, N) signals, one row for each map")
    else:
        if times is not None:
            times, moved = unix_times(times, moved)
        outcome = outcome_of(maps, commands, times, mirror, settings, hysteresis, moved)
    if provenance is None:
        now = time.time_ns()
        provenance = Provenance(new_id(mirror.name, mirror.serial, now), now)
    measured, options = outcome.maps(), options or FitOptions()
    found = fit_hysteresis(measured, limits=mirror.limits) if StepKind.EXCITATION in measured.kind else None
    fit = fit_effective(measured, found, options, mirror)
    check = check_fit(fit, mirror)
    limitations = [*fit.limitations, *(found.remarks if found else ()), *run_limitations]
    if not outcome.radius_known:
        limitations.append(
            f"The maps state no aperture radius; the mirror's working aperture ({mirror.working_radius * 1e3:.2f} mm "
            "radius) is used."
        )
    wavelength = outcome.setup.wavelength if outcome.setup else 0.0
    if wavelength == 0.0:
        limitations.append("The maps state no wavelength.")
    seen = measured.stamp_ns[np.isfinite(measured.coefficients).all(axis=1)]  # others may have estimated times
    if found and commands is not None and times is None and not (seen % 10**9).any():
        limitations.append("Times of the maps are whole seconds: creep of the first seconds is not well known.")
    if (parts := np.unique(measured.segment).size) > 1:
        limitations.append(f"Measured in {parts} parts: the run was interrupted and resumed.")
    limitations += _poke_sentences(check)
    limitations += [f"Measured differently: {remark}." for remark in outcome.remarks]
    made = Calibration(
        id=provenance.id,
        mirror_name=mirror.name,
        mirror_serial=mirror.serial,
        wavelength=wavelength,
        aperture_radius=mirror.working_radius,
        created_ns=provenance.created_ns,
        actuator_x=mirror.x,
        actuator_y=mirror.y,
        maps=measured,
        fit=fit,
        dropped=tuple(outcome.dropped),
        targets=tuple(outcome.targets),
        note=provenance.note,
        software_version=software_version(),
        hysteresis=found,
        **{name: getattr(outcome.setup, name) for name in _INSTRUMENT if outcome.setup},
        region_weights=_region_weights(measured, fit, options),
    )
    return replace(made, limitations=(*limitations, *not_followed(made)))


def _poke_sentences(check: PokeCheck) -> list[str]:
    """The findings as limitations."""
    return [f"{POKE_CHECK}{finding}." for finding in check.findings]


def _region_weights(maps: MapSet, fit: InfluenceFit, options: FitOptions) -> Floats:
    """(10,) weights for commands weighted by region; empty if the maps do not determine them."""
    if StepKind.SURFACE in maps.kind:
        with suppress(ValueError):  # the weights are an optional part of a calibration
            return weighting_of(maps, fit.used, options.folds, options.epsilon).weights
    return np.zeros(0)


def fit_effective(
    maps: MapSet, hysteresis: HysteresisFit | None, options: FitOptions, mirror: Mirror, exclude: Collection[str] = ()
) -> InfluenceFit:
    """The influence function of `maps`, on effective signals if hysteresis is known; raises as `fit_influence`."""
    if hysteresis is None:
        return fit_influence(maps, options, rings=mirror.rings, limits=mirror.limits, exclude=exclude)
    # With hysteresis followed, only the error of the law remains, so outliers are judged by that.
    floor = max(options.residual_floor, LAW_ERRORS * hysteresis.held_out_max_zernike)
    followed = replace(options, hysteresis_allowance=0.0, residual_floor=floor)
    fit = fit_influence(effective_maps(maps, hysteresis.law), followed, rings=mirror.rings, exclude=exclude)
    return replace(fit, signal_min=float(maps.applied.min()), signal_max=float(maps.applied.max()))


def refit(
    stored: Calibration,
    options: FitOptions,
    exclude: Collection[str],
    provenance: Provenance,
    mirror: Mirror | None = None,
) -> Calibration:
    """A new calibration from the raw data of `stored`, without the maps in `exclude`.

    Args:
        mirror: its limits give the error to allow for if hysteresis is not followed; None = limits not known.

    Raises:
        UnknownNameError: an unknown method or label.
        TooFewMapsError: the maps left do not determine the unknowns.
    """
    mirror = mirror or Mirror(
        stored.mirror_name, stored.mirror_serial, stored.actuator_x, stored.actuator_y, stored.aperture_radius
    )
    fit = fit_effective(stored.maps, stored.hysteresis, options, mirror, exclude)
    of_the_run = [
        sentence
        for sentence in stored.limitations
        if sentence not in stored.fit.limitations
        and not sentence.startswith(POKE_CHECK)
        and NOT_FOLLOWED not in sentence
    ]
    poked = _poke_sentences(check_fit(fit, mirror))  # a map left out may have been the cause of a finding
    without = f" without {', '.join(exclude)}" if exclude else ""
    if exclude and stored.hysteresis is not None:
        without += "; the hysteresis model and the promise are still those of all maps"
    made = replace(
        stored,
        id=provenance.id,
        created_ns=provenance.created_ns,
        fit=fit,
        region_weights=_region_weights(stored.maps, fit, options),
        limitations=(*fit.limitations, *of_the_run, *poked, f"Fitted again from the raw data of {stored.id}{without}."),
        note=provenance.note or stored.note,
        software_version=software_version(),
    )
    return replace(made, limitations=(*made.limitations, *not_followed(made)))
