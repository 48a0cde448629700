"""Duhem operators of each actuator, found from how the common one's values differ."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.calibration_messages import hysteresis_message
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.features import (
    fading_changes,
    fading_features,
    own_slopes,
    padded_slope,
)
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.hysteresis.own_laws import OwnLaws
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run
from dm_common.hysteresis.duhem import FadingHysteresis
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.messages import hysteresis_model_from

ACTUATORS, WEIGHT = 4, -0.2


def test_small_changes_of_the_slope_are_found() -> None:
    rng = np.random.default_rng(2)
    signals = rng.uniform(-1.0, 1.0, (300, ACTUATORS))
    common = padded_slope(np.array([1.4, 0.5]), ACTUATORS)
    true = common * (1.0 + 0.05 * rng.standard_normal(common.shape))
    values = WEIGHT * fading_features(signals, FadingHysteresis(true))[:, 0]
    columns = np.concatenate(
        (fading_features(signals, FadingHysteresis(common)), fading_changes(signals, common)), axis=1
    )
    weights = np.column_stack([np.linalg.lstsq(columns[..., n], values[:, n], rcond=None)[0] for n in range(ACTUATORS)])
    found = own_slopes(common, weights[0], weights[1:])
    left = WEIGHT * fading_features(signals, FadingHysteresis(found))[:, 0] - values
    assert np.abs(left).max() < 0.1 * np.abs(WEIGHT * columns[:, 0] - values).max()


def test_nothing_is_said_of_an_operator_without_weight() -> None:
    common = padded_slope(np.array([1.4, 0.5]), ACTUATORS)
    weight, changes = np.full(ACTUATORS, 1e-3), np.full((common[0].size, ACTUATORS), 0.1)
    assert own_slopes(common, weight, changes) == pytest.approx(common)


@pytest.mark.parametrize("own", [True, False])
def test_slopes_and_lags_of_each_actuator_come_back_from_the_message(own: bool) -> None:
    common = np.array([1.4, 0.5, 0.1])
    slope = np.tile(common, (ACTUATORS, 2, 1)) * np.linspace(0.9, 1.1, 2 * ACTUATORS).reshape(ACTUATORS, 2, 1)
    play = np.ones((ACTUATORS, 1, 1)) if own else np.ones((1, 1))
    weight = np.full(ACTUATORS, WEIGHT) if own else WEIGHT
    lag = np.full((ACTUATORS, 4), 2.0) if own else np.full(4, 2.0)
    law = HysteresisModel(
        *(np.zeros(1), play, slope if own else common, weight, 0.01, CREEP_TIMES),
        lag_spectrum=lag,
        creep_slope=-0.1,
        fading_rate=np.array([1.0, 3.0]),
        fading_weight=np.arange(6.0).reshape(2, 3) * (np.ones((ACTUATORS, 1, 1)) if own else 1.0),
    )
    back = hysteresis_model_from(hysteresis_message(HysteresisFit("Duhem", law, np.zeros(21), 1e-9, 0.02, 100, ())))
    assert back is not None
    assert back.same_as(law)


def test_the_law_of_a_single_actuator_comes_back_from_the_message() -> None:
    signals = np.random.default_rng(4).uniform(-1.0, 1.0, (60, 1))
    seen = 1e-6 * (signals + WEIGHT * fading_features(signals, FadingHysteresis(np.array([2.0])))[:, 0])
    all_maps = np.ones(60, dtype=bool)
    run = Run(signals, np.arange(60.0), Responses(seen, 1, all_maps))
    common = HysteresisModel(np.zeros(1), np.ones((1, 1)), np.array([1.4]), WEIGHT, 0.0, CREEP_TIMES)
    law = OwnLaws(run, CANDIDATES[-1], common, np.full(1, 1e-9), -np.inf).fit(all_maps).law
    back = hysteresis_model_from(hysteresis_message(HysteresisFit("Duhem", law, np.zeros(21), 1e-9, 0.02, 100, ())))
    assert back is not None
    np.testing.assert_allclose(run.follow(back), run.follow(law))
