"""Region weights: where they cancel (Eq. 7), where they act, and how epsilon is chosen (Eq. 8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import Provenance, calibrate, refit
from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.region_weighting import (
    EPSILON_CANDIDATES,
    RegionWeighting,
    choose_weighting,
    sample_surfaces,
    weighting_of,
)
from dm_calibration.influence.regression import METHODS, TooFewMapsError, make_design
from dm_calibration.influence.weights import (
    coefficient_operator,
    region_weights,
    surface_control_error,
)
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_common.errors import UnknownNameError
from dm_common.measurement import Measurement, Setup
from dm_common.optics.piston_tilt import remove_piston_tilt, weighted_fit
from dm_common.optics.sample_regions import EmptyRegionError, command_row_weights, point_weights, regional_rms
from dm_common.optics.sampling import SamplePoints, edge_clustered_points
from dm_common.optics.zernike import basis
from linear_mirror import LinearMirror, make_mirror

NM = 1e-9
POINTS = edge_clustered_points(300)
FALLING = np.linspace(1.0, 0.1, 10)


def make_maps(signals: np.ndarray, sag: np.ndarray, points: SamplePoints = POINTS) -> MapSet:
    coefficients = weighted_fit(sag, basis(points.x, points.y), points.weight)
    rest = [k for k in range(len(signals)) if not signals[k].any()]
    return MapSet.of(
        [
            Measurement(
                points=points,
                label=f"reference {k}" if k in rest else f"p{k:02d}",
                kind="reference" if k in rest else "surface",
                step=k,
                signals=signals[k],
                applied=signals[k],
                stamp_ns=k * 10**9,
                coefficients=coefficients[k],
                sigma=np.full(21, np.nan),
                sag=sag[k],
                residual_rms=1 * NM,
                valid_fraction=1.0,
            )
            for k in range(len(signals))
        ]
    )


def rim_maps(seed: int = 1, surfaces: int = 40, noise: float = 0.5 * NM) -> MapSet:
    """A mirror of five actuators whose print-through stands at the rim: there alone the errors vary."""
    random = np.random.default_rng(seed)
    terms = basis(POINTS.x, POINTS.y)
    r = np.hypot(POINTS.x, POINTS.y)[:, None]
    response = 300 * NM * (terms[:, 3:8] + random.uniform(-1, 1, 5) * r**30)
    signals = np.vstack((np.zeros(5), random.uniform(-1, 1, (surfaces, 5)), np.zeros(5)))
    sag = signals @ response.T + noise * random.standard_normal((surfaces + 2, 300))
    return make_maps(signals, sag)


def linear_maps(noise: float = 1 * NM, piston_tilt: float = 0.0) -> tuple[LinearMirror, MapSet]:
    mirror = make_mirror()
    plant = LinearMirror(mirror.x, mirror.y, noise=noise, piston_tilt=piston_tilt)
    steps = [s for s in make_plan(PlanKind.FULL, mirror, PlanOptions(degauss=False)).steps if s.signals is not None]
    signals = np.stack([step.signals for step in steps if step.signals is not None])
    maps = make_maps(signals, np.stack([plant.sag(s) for s in signals]), plant.points)
    return plant, replace(
        maps, label=tuple(f"{k} {step.label}" for k, step in enumerate(steps)), kind=tuple(s.kind.value for s in steps)
    )


def weighting(maps: MapSet, **options: float) -> RegionWeighting:
    return choose_weighting(make_design(maps), maps, remove_piston_tilt(maps.sag, maps.points), **options)  # type: ignore[arg-type]


def test_equation_8() -> None:
    variance = NM**2 * np.array([0.0, 3.0, 4.0, 12.0])
    found = region_weights(variance, 4.0 * NM**2)
    assert found == pytest.approx([1.0, 0.8, 1 / np.sqrt(2), 1 / np.sqrt(10)])


@pytest.mark.parametrize("epsilon", [0.0, -1e-18, np.nan, np.inf])
def test_epsilon_must_be_above_0(epsilon: float) -> None:
    with pytest.raises(ValueError, match=r"epsilon = .*: must be above 0 and finite"):
        region_weights(np.ones(10), epsilon)
    with pytest.raises(ValueError, match=r"epsilon = .*: must be above 0 and finite"):
        FitOptions(epsilon=epsilon)
    with pytest.raises(ValueError, match=r"epsilon = .*: must be above 0 and finite"):
        weighting(rim_maps(), epsilon=epsilon)


def test_variances_must_be_variances() -> None:
    for wrong in ([-1.0, 1.0], [np.nan], []):
        with pytest.raises(ValueError, match="must be one finite number"):
            region_weights(wrong, 1.0)


def test_points_get_the_weight_of_their_ring() -> None:
    assert point_weights(POINTS, np.full(10, 0.3)) == pytest.approx(0.3)
    found = point_weights(POINTS, FALLING)
    radius = np.hypot(POINTS.x, POINTS.y)
    assert (np.diff(found[np.argsort(radius, kind="stable")]) <= 1e-12).all()
    assert found.max() == 1.0 and found[radius.argmax()] == pytest.approx(0.1, abs=0.02)
    assert np.square(found) @ POINTS.weight == pytest.approx(np.square(FALLING).mean())
    with pytest.raises(ValueError, match="must be 10 finite numbers above 0, one per region"):
        point_weights(POINTS, FALLING[1:])
    with pytest.raises(ValueError, match="above 0"):
        point_weights(POINTS, FALLING - 0.1)


def test_place_a_the_weighted_coefficients() -> None:
    terms = basis(POINTS.x, POINTS.y)
    rough = np.random.default_rng(10).standard_normal((1, 300))
    equal = coefficient_operator(POINTS, np.ones(10))
    assert equal @ terms == pytest.approx(np.eye(21), abs=1e-9)
    assert rough @ equal.T == pytest.approx(weighted_fit(rough, terms, POINTS.weight))
    uneven = coefficient_operator(POINTS, FALLING)
    assert uneven @ terms == pytest.approx(np.eye(21), abs=1e-9)
    root = np.sqrt(POINTS.weight) * point_weights(POINTS, FALLING)
    expected = np.linalg.lstsq(root[:, None] * terms, root * rough[0], rcond=None)[0]
    assert rough[0] @ uneven.T == pytest.approx(expected)
    errors = [regional_rms(rough - rough @ operator.T @ terms.T, POINTS)[0] for operator in (equal, uneven)]
    assert errors[1][0] < errors[0][0] and errors[1][-1] > errors[0][-1]
    few = edge_clustered_points(20)
    with pytest.raises(ValueError, match="20 sampling points for 21 coefficients"):
        coefficient_operator(few, FALLING)
    line = SamplePoints(np.linspace(-1, 1, 50), np.zeros(50), np.full(50, 1 / 50))
    with pytest.raises(ValueError, match="do not separate the 21 terms"):
        coefficient_operator(line, FALLING)


def test_place_b_the_weighted_command() -> None:
    plant, _maps = linear_maps()
    wanted = 100 * NM * np.random.default_rng(11).standard_normal(300)
    equal, uneven = command_row_weights(POINTS, np.ones(10)), command_row_weights(POINTS, FALLING)
    assert equal == pytest.approx(np.sqrt(POINTS.weight))
    assert np.square(uneven).sum() == pytest.approx(1.0)
    errors = []
    for row in (equal, uneven):
        signals = np.linalg.lstsq(row[:, None] * plant.influence, row * wanted, rcond=None)[0]
        errors.append(regional_rms((wanted - plant.influence @ signals)[None], POINTS)[0])
    assert errors[1][0] < errors[0][0] and errors[1][-1] > errors[0][-1]


def test_surface_control_error_is_the_map_less_its_nominal_surface() -> None:
    plant, maps = linear_maps(noise=0.0, piston_tilt=1e-6)
    influence = plant.fit_terms(plant.influence.T).T
    error = surface_control_error(maps.sag, maps.applied, influence, maps.points)
    expected = plant.modes @ plant.figure_coefficients + maps.applied @ (plant.influence - plant.modes @ influence).T
    assert error == pytest.approx(remove_piston_tilt(expected, maps.points), abs=1e-6 * NM)
    with pytest.raises(ValueError, match=r"must be \(21, 37\)"):
        surface_control_error(maps.sag, maps.applied, influence[:, 1:], maps.points)


@pytest.mark.slow
def test_cross_validation_finds_weights_where_they_help() -> None:
    found = weighting(rim_maps())
    assert found.surfaces == 40 and weighting(replace(rim_maps(), step=np.arange(42) // 2)).surfaces == 21
    assert found.variance.argmax() == found.weights.argmin() == 9
    assert 0 < found.score.argmin() < len(EPSILON_CANDIDATES) - 1
    assert found.helps and found.score.min() < 0.9 * found.score_unweighted
    assert found.epsilon == found.candidates[found.score.argmin()]
    assert found.weights == pytest.approx(region_weights(found.variance, found.epsilon))
    assert found.candidates == pytest.approx(np.array(EPSILON_CANDIDATES) * np.median(found.variance))
    again = weighting(rim_maps())
    assert again.epsilon == found.epsilon and np.array_equal(again.score, found.score)


def test_cross_validation_prefers_mild_weights_where_none_help() -> None:
    """Errors that vary most in the centre: weights then take from the region that every other region contains."""
    random = np.random.default_rng(2)
    terms = basis(POINTS.x, POINTS.y)
    bump = np.exp(-np.square(np.hypot(POINTS.x, POINTS.y)[:, None] / 0.2))
    signals = np.vstack((np.zeros(5), random.uniform(-1, 1, (40, 5)), np.zeros(5)))
    response = 300 * NM * (terms[:, 3:8] + random.uniform(-1, 1, 5) * bump)
    maps = make_maps(signals, signals @ response.T + 0.5 * NM * random.standard_normal((42, 300)))
    found = weighting(maps)
    assert not found.helps
    assert found.epsilon == found.candidates[-1] and found.weights.min() > 0.95
    assert "no weights predict unseen maps better than equal ones" in found.sentence()


def test_the_curve_is_the_held_out_error() -> None:
    """One fold after the other by hand, for one candidate."""
    maps = rim_maps()
    found = weighting(maps, folds=4)
    sag = remove_piston_tilt(maps.sag, maps.points)
    design, terms = make_design(maps).matrix, basis(POINTS.x, POINTS.y)
    surfaces = np.flatnonzero(~maps.reference)
    squares = []
    for k in range(4):
        held = surfaces[k::4]
        train = np.setdiff1d(np.arange(len(maps)), held)
        seen = np.intersect1d(train, surfaces)
        g = np.linalg.lstsq(design[train], maps.coefficients[train], rcond=None)[0][-5:]
        error = remove_piston_tilt(sag[seen] - maps.applied[seen] @ g @ terms.T, POINTS)
        variance = regional_rms(error, POINTS).var(axis=0, ddof=1)
        predicted = design[held] @ np.linalg.lstsq(design[train], sag[train], rcond=None)[0]
        weights = region_weights(variance, found.candidates[5])
        fitted = predicted @ coefficient_operator(POINTS, weights).T @ terms.T
        squares.append(np.square(regional_rms(remove_piston_tilt(sag[held] - fitted, POINTS), POINTS)))
    assert found.score[5] == pytest.approx(np.sqrt(np.mean(np.concatenate(squares))), rel=1e-9)


def test_too_few_or_equal_surfaces_are_refused() -> None:
    maps = rim_maps()
    repeated = replace(maps, step=np.arange(len(maps)) % 3)
    with pytest.raises(TooFewMapsError, match=r"3 sample surfaces: .* need at least 4"):
        weighting(repeated)
    with pytest.raises(ValueError, match="use AZreg"):
        weighting(
            replace(
                maps, coefficients=maps.coefficients[:, :15], sigma=maps.sigma[:, :15], nominal=maps.nominal[:, :15]
            )
        )
    # A surface that never changes, whatever the signals: the same error in every map.
    figure = np.tile(200 * NM * np.cos(9 * POINTS.x), (len(maps), 1))
    with pytest.raises(ValueError, match="the regional errors are the same for all 40 sample surfaces"):
        weighting(make_maps(maps.signals, figure))


def test_pokes_stand_in_where_there_are_no_surfaces() -> None:
    _plant, maps = linear_maps()
    assert sample_surfaces(maps).sum() == maps.kind.count("surface") > 4
    pokes = maps.select(np.array([kind != "surface" for kind in maps.kind]))
    assert np.array_equal(sample_surfaces(pokes), ~pokes.reference)
    one_sided = pokes.select(np.array(["poke-" not in label for label in pokes.label]))
    assert 0.0 < weighting(one_sided).score_unweighted < np.inf  # of extrapolation, as nothing else is there


@pytest.mark.slow
@pytest.mark.parametrize("piston_tilt", [0.0, 1e-6])
def test_azwreg_regresses_the_weighted_coefficients(piston_tilt: float) -> None:
    _plant, maps = linear_maps(piston_tilt=piston_tilt)
    plain = fit_influence(maps)
    epsilon = float(np.median(weighting_of(maps, plain.used).variance)) / 3
    fit = fit_influence(maps, FitOptions("AZWreg", epsilon=epsilon))
    assert fit.method == "AZWreg" and "AZWreg" in METHODS
    assert fit.influence_sag == pytest.approx(plain.influence_sag)
    assert np.array_equal(fit.used, plain.used)
    found = weighting_of(maps, fit.used, epsilon=epsilon)
    assert found.prior and found.weights.min() < 0.9
    operator = coefficient_operator(maps.points, found.weights)
    assert fit.influence_zernike[3:] == pytest.approx((operator @ fit.influence_sag)[3:], abs=1e-6 * NM)
    assert np.abs(fit.influence_zernike - plain.influence_zernike)[3:].max() > 1 * NM
    if not piston_tilt:  # piston and tilt are then the mirror's own, and must have survived
        design = np.column_stack((np.ones(len(maps)), maps.applied))
        expected = np.linalg.lstsq(design, maps.sag @ operator.T, rcond=None)[0][1:].T
        assert fit.influence_zernike[:3] == pytest.approx(expected[:3], abs=5 * NM)
    assert any("region weights" in sentence and "given" in sentence for sentence in fit.limitations)


@pytest.mark.slow
def test_azwreg_with_points_without_data() -> None:
    _plant, maps = linear_maps(piston_tilt=1e-6)
    options = FitOptions("AZWreg", epsilon=1e-15)
    whole = fit_influence(maps, options)
    sag = maps.sag.copy()
    sag[np.random.default_rng(5).random(sag.shape) < 0.02] = np.nan
    gappy = fit_influence(replace(maps, sag=sag), options)
    assert np.abs(gappy.influence_zernike - whole.influence_zernike)[3:].max() < 5 * NM


@pytest.mark.slow
def test_a_region_that_a_surface_does_not_show_is_refused() -> None:
    """Its weight would come from sag that the fit made up."""
    _plant, maps = linear_maps()
    sag = maps.sag.copy()
    row = maps.kind.index("surface")
    sag[row, np.hypot(POINTS.x, POINTS.y) < 0.35] = np.nan
    holed = replace(maps, sag=sag)
    fit_influence(holed)
    with pytest.raises(
        EmptyRegionError, match=f"{maps.label[row]}: the concentric region of 10% .* measure the map again"
    ):
        fit_influence(holed, FitOptions("AZWreg"))
    assert fit_influence(holed, FitOptions("AZWreg"), exclude=[maps.label[row]]).method == "AZWreg"


def test_unknown_methods_list_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="method 'AZWerg' is unknown; did you mean AZWreg"):
        fit_influence(rim_maps(), FitOptions("AZWerg"))


def make_calibration(identifier: str = "one") -> Calibration:
    mirror = make_mirror(rings=1)
    plant = LinearMirror(mirror.x, mirror.y, noise=1 * NM)
    plan = [s for s in make_plan(PlanKind.FULL, mirror, PlanOptions(degauss=False)).steps if s.signals is not None]
    signals = np.stack([step.signals for step in plan if step.signals is not None])
    outcome = Outcome(setup=Setup(plant.points, 632.8e-9, -1))
    for number, (step, s) in enumerate(zip(plan, signals, strict=True)):
        sag = plant.sag(s)
        outcome.records.append(
            Measurement(
                points=plant.points,
                sag=sag,
                coefficients=plant.fit_terms(sag),
                sigma=np.full(21, np.nan),
                stamp_ns=number * 10**9,
                residual_rms=1 * NM,
                valid_fraction=1.0,
                label=step.label,
                kind=step.kind.value,
                step=number,
                signals=s,
                applied=s,
            )
        )
    return calibrate(outcome, mirror=mirror, options=FitOptions(), provenance=Provenance(identifier, 1))


@pytest.mark.slow
def test_a_stored_calibration_is_fitted_again_with_either_method() -> None:
    stored = make_calibration()
    again = refit(stored, FitOptions("AZWreg"), [], Provenance("two", 2))
    assert (stored.fit.method, again.fit.method) == ("AZreg", "AZWreg")
    assert any("AZWreg: coefficients fitted to the sag with region weights" in s for s in again.limitations)
    back = refit(again, FitOptions("AZreg"), [], Provenance("three", 3))
    assert back.fit.influence_zernike == pytest.approx(stored.fit.influence_zernike)
    assert not any("region weights" in sentence for sentence in back.limitations)
