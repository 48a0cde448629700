"""The influence function against a mirror whose response is known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.influence import quality
from dm_calibration.influence.fit import FitOptions, InfluenceFit, fit_influence
from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.regression import (
    METHODS,
    Design,
    TooFewMapsError,
    drift_columns,
    make_design,
    variance_at_points,
)
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_common.errors import UnknownNameError
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.optics.piston_tilt import remove_piston_tilt, rms
from linear_mirror import LinearMirror, make_mirror

NM = 1e-9


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return make_mirror()


def measure(
    plant: LinearMirror, mirror: Mirror, kind: PlanKind = PlanKind.POKES, drift_per_step: float = 0.0
) -> MapSet:
    """Maps of the steps of a plan that prescribe signals."""
    records = []
    for number, step in enumerate(make_plan(kind, mirror, PlanOptions(degauss=False)).steps):
        if step.signals is None:
            continue
        sag = plant.sag(step.signals, drift_per_step * number)
        records.append(
            Measurement(
                points=plant.points,
                label=step.label,
                kind=step.kind.value,
                step=number,
                signals=step.signals,
                applied=step.signals,
                stamp_ns=number * 2 * 10**9,
                coefficients=plant.fit_terms(sag),
                sigma=np.full(21, np.nan),
                sag=sag,
                residual_rms=1 * NM,
                valid_fraction=1.0,
            )
        )
    return MapSet.of(records)


def _azimuthal_orders(n: int) -> list[int]:
    """Order m of each term of radial order n; m > 0 has a cosine and a sine."""
    return [m for m in range(n % 2, n + 1, 2) for _part in range(1 if m == 0 else 2)]


#: rms of the peak-normalised terms over the disc, by radial order n: 1/sqrt(n + 1) for m = 0, else 1/sqrt(2 (n + 1)).
RMS = np.array(
    [[1 / np.sqrt(n + 1) if m == 0 else 1 / np.sqrt(2 * (n + 1))] for n in range(6) for m in _azimuthal_orders(n)]
)


def true_sag(plant: LinearMirror) -> np.ndarray:
    return remove_piston_tilt(plant.influence.T, plant.points).T


def test_exact_data_give_the_exact_influence_function(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y)
    fit = fit_influence(measure(plant, mirror, PlanKind.FULL), rings=mirror.rings)
    assert np.abs(fit.influence_sag - true_sag(plant)).max() < 1e-6 * NM
    assert np.abs(fit.influence_zernike - plant.fit_terms(plant.influence.T).T).max() < 1e-6 * NM
    assert fit.zernike_offset == pytest.approx(plant.figure_coefficients, abs=1e-6 * NM)
    assert fit.held_out_rms < 1e-5 * NM
    assert fit.used.all()
    assert (fit.grades == quality.GRADE_GOOD).all()
    assert (fit.signal_min, fit.signal_max) == (-1.0, 1.0)
    singular = np.linalg.svd((RMS * fit.influence_zernike)[1:], compute_uv=False)
    assert fit.condition_number == pytest.approx(singular[0] / singular[-1])


def test_it_is_the_least_squares_solution_of_equation_6(mirror: Mirror) -> None:
    """With two reference frames and no drift columns the regression is lstsq with an intercept."""
    plant = LinearMirror(mirror.x, mirror.y, noise=3 * NM)
    maps = measure(plant, mirror)
    maps = replace(maps, kind=tuple("poke" for _ in maps.kind))
    fit = fit_influence(maps)
    design = np.column_stack((np.ones(len(maps)), maps.applied))
    expected = np.linalg.lstsq(design, maps.coefficients, rcond=None)[0]
    assert fit.influence_zernike == pytest.approx(expected[1:].T, abs=1e-6 * NM)
    assert fit.zernike_offset == pytest.approx(expected[0], abs=1e-6 * NM)
    assert any("too few reference frames, or too few other maps" in sentence for sentence in fit.limitations)


def test_unknown_piston_and_tilt_do_not_disturb(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y, piston_tilt=2e-6)
    fit = fit_influence(measure(plant, mirror))
    assert np.abs(fit.influence_sag - true_sag(plant)).max() < 1e-6 * NM
    assert fit.influence_zernike[3:] == pytest.approx(plant.fit_terms(plant.influence.T).T[3:], abs=1e-6 * NM)
    assert any("do not show the mirror's tilt" in sentence for sentence in fit.limitations)
    singular = np.linalg.svd((RMS * fit.influence_zernike)[3:], compute_uv=False)
    assert fit.condition_number == pytest.approx(singular[0] / singular[-1])


def test_drift_is_followed_by_the_reference_frames(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y)
    maps = measure(plant, mirror, drift_per_step=0.05)
    followed = fit_influence(maps)
    ignored = fit_influence(replace(maps, kind=tuple("poke" for _ in maps.kind)))
    error = np.abs(followed.influence_sag - true_sag(plant)).max()
    assert error < 1e-6 * NM
    assert np.abs(ignored.influence_sag - true_sag(plant)).max() > 1 * NM
    assert followed.drift_rms > 5 * NM


def test_drift_columns_are_hat_functions() -> None:
    stamps = np.array([0, 5, 10, 15, 20, 30]) * 10**9
    reference = np.array([True, False, True, False, False, False])
    steps = np.arange(6)
    columns = drift_columns(stamps, reference, steps)
    assert columns == pytest.approx(np.array([[1, 0], [0.5, 0.5], [0, 1], [0, 1], [0, 1], [0, 1]]))
    assert drift_columns(stamps[::-1].copy(), reference, steps).sum(axis=1) == pytest.approx(1.0)
    assert drift_columns(stamps, np.zeros(6, dtype=bool), steps).tolist() == [[1.0]] * 6
    repeated = drift_columns(stamps, steps != 3, np.array([0, 0, 0, 1, 2, 2]))  # knots at 5 and 25 s
    assert repeated == pytest.approx(np.array([[1, 0], [1, 0], [0.75, 0.25], [0.5, 0.5], [0.25, 0.75], [0, 1]]))


def test_the_figure_of_a_resumed_run_is_that_of_its_last_part(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y)
    maps = measure(plant, mirror)
    resumed = np.arange(len(maps)) >= np.flatnonzero(maps.reference)[3]
    change = 0.5 * plant.figure_coefficients
    sag, coefficients = (
        values + np.outer(resumed, now)
        for values, now in ((maps.sag, plant.modes @ change), (maps.coefficients, change))
    )
    fit = fit_influence(replace(maps, sag=sag, coefficients=coefficients, segment=resumed.astype(int)))
    assert np.abs(fit.influence_sag - true_sag(plant)).max() < 1e-6 * NM
    assert fit.zernike_offset == pytest.approx(plant.figure_coefficients + change, abs=1e-6 * NM)


def test_standard_errors_are_the_scatter_of_repeated_calibrations(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y, noise=5 * NM)
    fits = [fit_influence(measure(plant, mirror)) for _ in range(4)]
    errors = np.stack([rms((fit.influence_sag - true_sag(plant)).T, plant.points.weight) for fit in fits])
    observed = np.sqrt(np.mean(np.square(errors), axis=0))
    claimed = fits[0].standard_error
    assert np.median(observed / claimed) == pytest.approx(1.0, abs=0.1)


def test_held_out_error_is_that_of_new_maps(mirror: Mirror) -> None:
    noise = 4 * NM
    plant = LinearMirror(mirror.x, mirror.y, noise=noise)
    fit = fit_influence(measure(plant, mirror, PlanKind.FULL))
    # In the sample the fit has followed part of the noise; held out, its own error comes on top.
    assert fit.in_sample_rms < noise < fit.held_out_rms < 2.5 * noise


def test_maps_that_nothing_else_can_predict_do_not_count_as_held_out(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y, noise=2 * NM)
    maps = measure(plant, mirror)
    one_sided = maps.select(np.array([not label.startswith("poke-") for label in maps.label[:-1]] + [True]))
    design = make_design(one_sided)
    responses = np.hstack((one_sided.coefficients, one_sided.sag))
    fold = quality.folds_of(one_sided.step, ~one_sided.reference, 10)
    _, tested = quality.held_out_residual(design, responses, fold)
    assert not tested.any()
    fit = fit_influence(one_sided, limits=mirror.limits)
    text = " ".join(fit.limitations)
    assert "held-out error comes from extrapolation" in text and "show hysteresis" not in text
    assert np.isfinite([fit.held_out_rms, fit.held_out_max_zernike]).all()
    mixed = maps.select(np.array([label != "poke-09" for label in maps.label]))
    fit = fit_influence(mixed)
    assert any("1 map moves an actuator as no other map does" in sentence for sentence in fit.limitations)
    assert fit.held_out_rms < 10 * NM


def test_what_blurs_all_actuators_is_no_fault_of_one() -> None:
    response, excited = np.full(37, 1.0), np.ones(37, dtype=bool)
    options = FitOptions(dead_sigmas=3.0, weak_sigmas=10.0, weak_share=0.4)
    error = np.full(37, 0.15)
    assert (quality.grade(response, response, error, excited, None, options) == quality.GRADE_GOOD).all()
    assert "known to 15 % only" in quality.blur(response, error, excited, 10.0)[0].replace("15%", "15 %")
    assert not quality.blur(response, 0.1 * error, excited, 10.0)
    error[3] = 0.32
    silent = quality.grade(np.zeros(37), np.zeros(37), np.zeros(37), excited, None, options)
    assert (silent == quality.GRADE_DEAD).all(), "maps of nothing"
    grades = quality.grade(response, response, error, excited, None, options)
    assert grades.tolist() == [0] * 3 + [quality.GRADE_WEAK] + [0] * 33


def test_grades(mirror: Mirror) -> None:
    gains = np.ones(37)
    gains[4], gains[11] = 0.0, 0.1
    maps = measure(LinearMirror(mirror.x, mirror.y, noise=2 * NM, gains=gains), mirror)
    moving_7 = maps.applied[:, 6] != 0.0
    fit = fit_influence(maps.select(~moving_7), rings=mirror.rings)
    expected = np.full(37, quality.GRADE_GOOD)
    expected[4], expected[11], expected[6] = quality.GRADE_DEAD, quality.GRADE_WEAK, quality.GRADE_NOT_EXCITED
    assert fit.grades.tolist() == expected.tolist()
    assert (fit.influence_sag[:, 6] == 0.0).all()
    text = " ".join(fit.limitations)
    assert "Actuator 5 shows no response above the noise." in text
    assert "Actuator 12 responds weakly or uncertainly." in text
    assert "Actuator 7 was never moved" in text


def test_an_actuator_beside_the_aperture_is_not_dead_for_the_loops_of_the_others(mirror: Mirror) -> None:
    """Loops leave figures over the whole aperture, beside which the rms of a bump at its rim alone is small."""
    corners, silent = np.hypot(mirror.x, mirror.y) > 12.8e-3, 23
    gains = np.where(corners, 0.4, 1.0)
    gains[silent] = 0.0
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM, gains=gains)
    maps = measure(plant, mirror)
    left = 0.2 * np.abs(maps.applied) @ plant.influence.T
    maps = replace(maps, sag=maps.sag + left, coefficients=maps.coefficients + plant.fit_terms(left))
    fit = fit_influence(maps, rings=mirror.rings)
    assert (fit.response < 3.0 * fit.standard_error).sum() > 4
    assert np.flatnonzero(fit.grades == quality.GRADE_DEAD).tolist() == [silent]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_dead_actuator_is_dead_also_where_points_have_data_in_few_maps(mirror: Mirror, seed: int) -> None:
    """They are known less well than the others."""
    silent = 4
    gains = np.where(np.arange(37) == silent, 0.0, 1.0)
    plant = LinearMirror(mirror.x, mirror.y, noise=40 * NM, gains=gains, seed=seed)
    maps = measure(plant, mirror, PlanKind.FULL)
    rim = np.hypot(plant.points.x, plant.points.y) > 0.9
    gaps = rim & (np.random.default_rng(seed).random(maps.sag.shape) < 0.2)
    fit = fit_influence(replace(maps, sag=np.where(gaps, np.nan, maps.sag)), rings=mirror.rings)
    assert np.flatnonzero(fit.grades == quality.GRADE_DEAD).tolist() == [silent]


def test_the_variance_at_a_point_is_that_of_a_fit_to_its_maps() -> None:
    random = np.random.default_rng(3)
    design = Design(np.column_stack((np.ones(12), random.standard_normal((12, 3)))), 1, np.ones(3, dtype=bool))
    seen = np.ones((12, 3), dtype=bool)
    seen[[2, 7, 8], 1] = False
    seen[3:, 2] = False
    found = variance_at_points(design, seen)
    for point in (0, 1):
        rows = design.matrix[seen[:, point]]
        assert found[:, point] == pytest.approx(np.diag(np.linalg.inv(rows.T @ rows)))
    assert np.isinf(found[:, 2]).all(), "3 maps do not determine 4 unknowns"


def reasons_of(fit: InfluenceFit, maps: MapSet) -> dict[str, str]:
    return {label: reason for label, reason in zip(maps.label, fit.reasons, strict=True) if reason}


def test_bad_maps_are_dropped_with_their_reason(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM)
    maps = measure(plant, mirror, PlanKind.FULL)
    sag, coefficients, valid = maps.sag.copy(), maps.coefficients.copy(), maps.valid_fraction.copy()
    at = {label: i for i, label in enumerate(maps.label)}
    valid[at["poke+03"]] = 0.2
    coefficients[at["poke-05"], 7] = np.nan
    sag[at["p07"], :100] = np.nan
    sag[at["p08"], 3] = np.inf
    sag[at["p20"]] = sag[at["p21"]]  # the map of another surface
    bad = replace(maps, sag=sag, coefficients=coefficients, valid_fraction=valid)
    fit = fit_influence(bad, exclude=["p09"])
    reasons = reasons_of(fit, maps)
    assert reasons.keys() == {"poke+03", "poke-05", "p07", "p08", "p20", "p09"}
    assert "too few valid pixels: 20.0%" in reasons["poke+03"]
    assert "Zernike coefficient is not finite" in reasons["poke-05"]
    assert "sampling points have no data" in reasons["p07"]
    assert "infinite" in reasons["p08"]
    assert "outlier" in reasons["p20"] and "nm rms" in reasons["p20"]
    assert reasons["p09"] == "excluded by request"
    assert np.abs(fit.influence_sag - true_sag(plant)).max() < 8 * NM
    assert np.isnan(fit.map_residual[~fit.used]).all()


def test_maps_that_lack_a_part_are_left_out_unless_they_are_many(mirror: Mirror) -> None:
    maps = measure(LinearMirror(mirror.x, mirror.y, noise=1 * NM), mirror)
    valid, sag = np.full(len(maps), 0.99), maps.sag.copy()
    valid[[3, 5]] = 0.9  # map 5: pixels here and there
    sag[3, maps.points.x > 0.9] = sag[7, np.hypot(maps.points.x, maps.points.y) > 0.99] = np.nan  # map 7: a thin rim
    assert not reasons_of(fit_influence(replace(maps, sag=sag, valid_fraction=valid)), maps)  # nor of a run of pokes
    maps = replace(maps, kind=(StepKind.EXCITATION,) * len(maps))
    reasons = reasons_of(fit_influence(replace(maps, sag=sag, valid_fraction=valid)), maps)
    assert reasons.keys() == {maps.label[3]}
    assert "a part of the surface is missing: 90.0% of the aperture is valid" in reasons[maps.label[3]]
    many = slice(int(0.3 * len(maps)))
    valid[many], sag[many] = 0.9, np.where(maps.points.x > 0.9, np.nan, maps.sag[many])
    assert not reasons_of(fit_influence(replace(maps, sag=sag, valid_fraction=valid)), maps)


@pytest.mark.parametrize("middle", [-1.0, 0.0, 3.0])
def test_a_bad_map_is_an_outlier_wherever_mid_range_is(mirror: Mirror, middle: float) -> None:
    """What hysteresis may explain of a map follows from how far the mirror moved, not from the signals' zero.

    Which of the two pokes of an actuator is the bad one they do not show: both lie equally far from their common fit.
    """
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM)
    maps = measure(plant, mirror)
    sag = maps.sag.copy()
    sag[maps.label.index("poke+20")] += 300 * NM * plant.modes[:, 4]
    bad = replace(maps, sag=sag, coefficients=plant.fit_terms(sag), applied=maps.applied + middle)
    assert reasons_of(fit_influence(bad), bad).keys() in ({"poke+20"}, {"poke-20"})


def test_hysteresis_is_not_called_an_outlier(mirror: Mirror) -> None:
    """Every move falls short or goes too far by up to 7.5 % of itself, as a loop of 15 % does."""
    plant = LinearMirror(mirror.x, mirror.y, noise=0.5 * NM)
    random = np.random.default_rng(4)
    maps = measure(plant, mirror, PlanKind.FULL)
    moved = maps.applied * (1.0 + 0.075 * random.uniform(-1.0, 1.0, maps.applied.shape))
    sag = plant.modes @ plant.figure_coefficients + moved @ plant.influence.T
    fit = fit_influence(replace(maps, sag=sag, coefficients=plant.fit_terms(sag)))
    assert fit.used.all(), reasons_of(fit, maps)
    assert fit.held_out_rms > 20 * NM


def test_points_without_data_cost_nothing_but_themselves(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM, piston_tilt=1e-6)
    maps = measure(plant, mirror)
    whole = fit_influence(maps)
    sag = maps.sag.copy()
    random = np.random.default_rng(5)
    sag[random.random(sag.shape) < 0.02] = np.nan
    gappy = fit_influence(replace(maps, sag=sag))
    assert gappy.used.all()
    error = rms((gappy.influence_sag - true_sag(plant)).T, plant.points.weight)
    best = rms((whole.influence_sag - true_sag(plant)).T, plant.points.weight)
    assert np.median(error) < 1.2 * np.median(best)


def test_gaps_make_no_figure_better(mirror: Mirror) -> None:
    """What is filled in follows the fit and says nothing of its error."""
    maps = measure(LinearMirror(mirror.x, mirror.y, noise=2 * NM), mirror)
    whole, sag = fit_influence(maps), maps.sag.copy()
    sag[np.random.default_rng(5).random(sag.shape) < 0.15] = np.nan
    gappy = fit_influence(replace(maps, sag=sag))
    assert np.median(gappy.standard_error) == pytest.approx(np.median(whole.standard_error), rel=0.1)
    assert gappy.held_out_rms > 0.85 * whole.held_out_rms and gappy.in_sample_rms > 0.85 * whole.in_sample_rms
    assert quality.seen_rms(np.array([[2.0, 0.0]]), np.array([[0.0, np.nan]]), np.array([0.3, 0.7])) == [2.0]


def test_a_rim_that_most_maps_do_not_show_is_fitted_to_those_that_do() -> None:
    """For points that half of the maps show, rounds of filling alone took hundreds to converge."""
    mirror = make_mirror(rings=2)
    plant, random = LinearMirror(mirror.x, mirror.y, noise=1 * NM, piston_tilt=1e-6), np.random.default_rng(0)
    maps = measure(plant, mirror, PlanKind.FULL)
    applied = random.uniform(-1.0, 1.0, maps.applied.shape) * ~maps.reference[:, None]
    sag = np.stack([plant.sag(row) for row in applied])
    maps = replace(maps, applied=applied, sag=sag, coefficients=plant.fit_terms(sag))
    rim = plant.points.x > 0.8
    sag[np.ix_(random.random(len(maps)) < 0.5, rim)] = np.nan
    fit = fit_influence(replace(maps, sag=sag))
    assert np.abs(fit.influence_sag - true_sag(plant))[rim].max() < 3 * NM
    assert not any("sampling points" in sentence for sentence in fit.limitations)


def test_a_point_without_data_where_an_actuator_moves_is_told(mirror: Mirror) -> None:
    maps = measure(LinearMirror(mirror.x, mirror.y), mirror)
    sag = maps.sag.copy()
    sag[[maps.label.index(label) for label in ("poke+20", "poke-20")], 17] = np.nan
    fit = fit_influence(replace(maps, sag=sag))
    assert any("1 of the 300 sampling points" in sentence for sentence in fit.limitations)


def test_one_point_never_seen(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y)
    maps = measure(plant, mirror)
    sag = maps.sag.copy()
    sag[:, 17] = np.nan
    fit = fit_influence(replace(maps, sag=sag))
    assert np.isfinite(fit.influence_sag).all()
    assert any("1 of the 300 sampling points have no data in any map" in sentence for sentence in fit.limitations)


def test_too_few_maps_are_refused_in_words(mirror: Mirror) -> None:
    plant = LinearMirror(mirror.x, mirror.y)
    maps = measure(plant, mirror)
    few = maps.select(np.arange(len(maps)) < 20)
    alone = np.arange(len(few)) < 6
    with pytest.raises(TooFewMapsError, match=r"\d+ good maps for \d+ unknowns"):
        fit_influence(few.select(alone).select(np.array([True, True, False, True, False, False])))
    together = replace(maps, applied=np.repeat(maps.applied.sum(axis=1, keepdims=True), 37, axis=1))
    with pytest.raises(TooFewMapsError, match="do not separate actuators 1, 2, 3"):
        fit_influence(together)
    still = replace(maps, applied=np.zeros_like(maps.applied))
    with pytest.raises(TooFewMapsError, match="no actuator was moved"):
        fit_influence(still)
    blind = replace(maps, valid_fraction=np.zeros(len(maps)))
    with pytest.raises(TooFewMapsError, match="none of the 83 maps is usable"):
        fit_influence(blind)
    with pytest.raises(TooFewMapsError, match="no command has a map"):
        fit_influence(replace(maps, coefficients=maps.coefficients * np.nan, sag=maps.sag * np.nan))


def test_unknown_method_and_label(mirror: Mirror) -> None:
    maps = measure(LinearMirror(mirror.x, mirror.y), mirror)
    assert "AZreg" in METHODS
    with pytest.raises(UnknownNameError, match="method 'AZreq' is unknown; did you mean AZreg"):
        fit_influence(maps, FitOptions(method="AZreq"))
    with pytest.raises(UnknownNameError, match=r"map label 'poke\+1' is unknown; did you mean poke\+"):
        fit_influence(maps, exclude=["poke+1"])


@pytest.mark.parametrize("dead", [0, 3])
def test_a_dead_actuator_shows_no_hysteresis_and_hides_none(dead: int) -> None:
    mirror, gains = make_mirror(rings=1), np.ones(7)
    gains[dead] = 0.0
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM, gains=gains)
    assert fit_influence(measure(plant, mirror), rings=mirror.rings).held_out_max_zernike < 3 * NM
    # What a share of a move comes to, without and with noise in the place of a response.
    whole = LinearMirror(mirror.x, mirror.y)
    alive = whole.fit_terms(whole.influence.T).T
    known = alive * gains + 0.1 * NM * np.random.default_rng(1).standard_normal(alive.shape) * (1.0 - gains)
    expected, allowed = (quality.with_loops(0.0, 0.1, influence, mirror.limits)[0] for influence in (alive, known))
    assert allowed > 0.5 * expected > 10 * NM
