"""Regression of the surface control error: responses, weights, hysteresis, prediction of commands to come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.features import play_features
from dm_calibration.influence.fit import fit_influence
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_calibration.regression.predictor import fit_predictor
from dm_calibration.regression.sag_history import RunHistory
from dm_calibration.regression.surface_error import model_candidates, surface_errors, surface_weights
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.zernike import basis
from hysteretic_mirror import calibrated, calibrated_by_pokes, lagging_bench
from linear_mirror import make_mirror


def test_response_is_the_rms_of_the_map_against_its_nominal_surface() -> None:
    maps, fit = calibrated()
    errors = surface_errors(maps, fit)
    assert len(errors.labels) == 58 and errors.regional.shape == (58, 10)
    row = maps.label.index("p44")
    nominal = basis(maps.points.x, maps.points.y) @ fit.influence_zernike @ maps.applied[row]
    error = remove_piston_tilt((maps.sag[row] - nominal)[np.newaxis], maps.points)[0]
    expected = np.sqrt(np.sum(maps.points.weight * error**2))
    assert errors.response[errors.labels.index("p44")] == pytest.approx(expected)


def test_weights_of_surfaces_follow_eq_8() -> None:
    maps, fit = calibrated()
    errors = surface_errors(maps, fit)
    weights = surface_weights(errors)
    assert np.mean(1.0 / weights) == pytest.approx(1.0)
    variance = errors.regional.var(axis=1, ddof=1)
    ratio = weights * np.hypot(1.0, variance / np.median(variance))
    assert ratio == pytest.approx(np.full(58, ratio[0]))
    flat = replace(errors, regional=np.ones((58, 10)))
    with pytest.raises(ValueError, match="use AZreg"):
        surface_weights(flat)


@pytest.mark.slow
def test_what_cannot_be_regressed_is_refused() -> None:
    with pytest.raises(TooFewMapsError, match="calibrate with the plan full"):
        fit_predictor(*calibrated_by_pokes())
    maps, _ = calibrated()
    few = np.array([not (label.startswith("p") and label[1:].isdigit() and int(label[1:]) > 9) for label in maps.label])
    kept = maps.select(few)
    with pytest.raises(TooFewMapsError, match=r"9 samples: .* measure more surfaces"):
        fit_predictor(kept, fit_influence(kept))


def test_play_operators_by_hand() -> None:
    applied = np.array([[0.0], [1.0], [0.8], [-1.0]])
    features = play_features(applied, np.array([0.0, 0.05, 0.5]), 1)[:, :, 0]
    assert features[:, 0] == pytest.approx(applied[:, 0])
    assert features[:, 1] == pytest.approx([0.0, 0.95, 0.85, -0.95])
    assert features[:, 2] == pytest.approx([0.0, 0.5, 0.5, -0.5])  # 0.8 lies inside the play


def test_the_law_of_a_known_hysteresis_is_found() -> None:
    maps, fit = calibrated()
    history = RunHistory(maps, fit.sag_offset + maps.applied @ fit.influence_sag.T)
    keep = np.arange(len(maps)) % 3 != 0
    sag = history.predict(keep)
    left = remove_piston_tilt(maps.sag - sag, maps.points)[~keep]
    rms = np.sqrt(np.square(left) @ maps.points.weight)
    linear = remove_piston_tilt(maps.sag - fit.sag_offset - maps.applied @ fit.influence_sag.T, maps.points)[~keep]
    assert np.median(rms) < 0.4 * np.median(np.sqrt(np.square(linear) @ maps.points.weight))


@pytest.mark.slow
def test_an_actuator_that_never_moved_is_no_candidate() -> None:
    maps, _ = calibrated()
    maps = replace(maps, applied=maps.applied * (np.arange(37) != 4))
    fit = fit_influence(maps)
    names, candidates = model_candidates(maps, fit, surface_errors(maps, fit), lambda _: maps.sag)
    assert len(names) == candidates.shape[1] == 37 and "s05" not in names
    mean, lower, upper = fit_predictor(maps, fit).predict(maps.applied[maps.label.index("p44")])
    assert 0.0 <= lower <= mean <= upper


@pytest.mark.slow
def test_errors_of_sixty_one_actuators_are_predicted() -> None:
    """The surfaces of Table 1 do not tell those of the outermost ring apart."""
    mirror = make_mirror(rings=4)
    maps = Procedure(make_plan(PlanKind.FULL, mirror), mirror, lagging_bench(mirror)).run().maps()
    fit = fit_influence(maps)
    _, candidates = model_candidates(maps, fit, surface_errors(maps, fit), lambda _: maps.sag)
    assert 38 < candidates.shape[1] < 62
    mean, lower, upper = fit_predictor(maps, fit).predict(maps.applied[maps.label.index("p44")])
    assert 0.0 <= lower <= mean <= upper


@pytest.mark.slow
def test_commands_to_come_lie_in_their_intervals() -> None:
    maps, fit = calibrated()
    predictor = fit_predictor(maps, fit)
    bench = lagging_bench()
    rng = np.random.default_rng(21)
    smooth = maps.applied[[label.startswith("pz") or label in ("p55", "p56") for label in maps.label]]
    smooth /= np.abs(smooth).max(axis=1, keepdims=True)
    inside = []
    for _ in range(60):
        signals = rng.uniform(-1.0, 1.0) * smooth[rng.integers(len(smooth))]
        bench.apply(signals)
        nominal = basis(maps.points.x, maps.points.y) @ fit.influence_zernike @ signals
        error = remove_piston_tilt((bench.sag() - nominal)[np.newaxis], maps.points)[0]
        actual = np.sqrt(np.sum(maps.points.weight * error**2))
        mean, lower, upper = predictor.predict(signals)
        assert 0.0 <= lower <= mean <= upper
        inside.append(lower <= actual <= upper)
    assert np.mean(inside) >= 0.8
