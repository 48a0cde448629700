"""Messages of dm_msgs and the types that several nodes share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import ActuatorHysteresis, ActuatorState, MirrorInfo
from dm_msgs.srv import Measure

from dm_common.errors import ErrorCode
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_common.messages import (
    applied_from,
    driver_refusal,
    hysteresis_model_from,
    measurement_from,
    mirror_from,
    recipe_book_from,
    recipe_book_message,
    seconds,
    stamp_ns,
    time_message,
)
from dm_common.optics.zernike import SPOKEN
from dm_common.recipes import Recipe, RecipeBook, RecipeError

X, Y = hexagonal_positions(7)
PAIRS = neighbour_pairs(X, Y)


def mirror_info(**fields: Any) -> MirrorInfo:
    described: dict[str, Any] = {
        "name": "PDM",
        "serial": "7",
        "actuators": 7,
        "actuator_x": X.tolist(),
        "actuator_y": Y.tolist(),
        "neighbour_a": PAIRS[:, 0].tolist(),
        "neighbour_b": PAIRS[:, 1].tolist(),
        "working_aperture_diameter": 22e-3,
        "signal_min": -0.5,
        "signal_max": 1.0,
        "neighbour_difference_max": 0.8,
    }
    return MirrorInfo(**described | fields)


def test_times_go_there_and_back() -> None:
    stamp = 1_700_000_000_123_456_789
    assert stamp_ns(time_message(stamp)) == stamp
    assert seconds(time_message(stamp)) == pytest.approx(1e-9 * stamp)


def test_a_mirror_is_what_the_driver_describes() -> None:
    mirror = mirror_from(mirror_info())
    assert (mirror.name, mirror.serial, mirror.actuators, mirror.working_radius) == ("PDM", "7", 7, 11e-3)
    limits = mirror.limits
    assert (limits.low, limits.high, limits.neighbour_difference) == (-0.5, 1.0, 0.8)
    assert (limits.pairs == PAIRS).all()
    assert mirror.rest == pytest.approx(np.full(7, 0.25))
    assert len(mirror_from(mirror_info(neighbour_a=[], neighbour_b=[])).limits.pairs) == 0


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"actuator_x": [0.0]}, "actuator_x has 1 value: must have 7"),
        ({"neighbour_a": [0]}, "neighbour_a has 1 value, neighbour_b 12: must have as many"),
        ({"neighbour_a": [0] * 12, "neighbour_b": [7] * 12}, r"indices must lie in 0\.\.6"),
        ({"working_aperture_diameter": 0.0}, "working_radius = 0.0: must be positive"),
        ({"signal_min": 1.0}, "the lower limit must be below the upper"),
        ({"neighbour_difference_max": 0.0}, "neighbour_difference = 0: must be positive"),
    ],
)
def test_a_mirror_that_makes_no_sense_is_refused(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        mirror_from(mirror_info(**fields))


def test_reports_of_the_driver() -> None:
    message = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE, turns=3, degausses=1, history_known=True)
    message.header.stamp = time_message(2_500_000_000)
    message.applied, message.turned_at = [0.1, 0.2], [0.3, 0.4]
    report = applied_from(message)
    assert (report.time, report.turns, report.degausses, report.history_known) == (2.5, 3, 1, True)
    assert report.active and not report.moving
    assert report.turned_at is not None and report.turned_at.tolist() == [0.3, 0.4]
    message.turned_at = []
    assert applied_from(message).turned_at is None


def test_a_map_of_another_convention_or_without_samples_is_refused() -> None:
    answer = Measure.Response()
    with pytest.raises(ValueError, match="samples: has 0 sag, 0 x, 0 y, 0 weight: must have as many of each"):
        measurement_from(answer)
    answer.zernike.convention = "noll"
    with pytest.raises(ValueError, match=r"zernike\.convention = 'noll'"):
        measurement_from(answer)


def test_hysteresis_that_was_not_identified_and_one_that_makes_no_sense() -> None:
    assert hysteresis_model_from(ActuatorHysteresis()) is None
    with pytest.raises(ValueError, match="play_weight has 3 values: must be 2 x 1"):
        hysteresis_model_from(ActuatorHysteresis(play_radius=[0.0, 0.5], play_weight=[1.0, 2.0, 3.0], powers=1))
    one = ActuatorHysteresis(play_radius=[0.0], play_weight=[1.0], powers=1, fading_rate=[1.0, 3.0])
    one.fading_weight = [0.1, 0.2, 0.3]
    with pytest.raises(ValueError, match="fading_weight has 3 values: must be 2 x any"):
        hysteresis_model_from(one)


ASTIGMATISM = tuple(2e-7 * (name == "astigmatism cos") for name in SPOKEN)


def recipe(curvature: float, actuators: int = 2, zernike: tuple[float, ...] = ()) -> Recipe:
    signals = np.full(actuators, curvature)
    built = 1_700_000_000_000_000_000
    return Recipe(curvature, 0.0, signals, signals + 0.1, 1e-10, 2e-10, 5, zernike, signals + 0.2, built)


def test_recipes_go_there_and_back() -> None:
    book = RecipeBook((recipe(-0.01), recipe(0.0, zernike=ASTIGMATISM)), 100, 3e-10)
    message = recipe_book_message(book, "c")
    back = recipe_book_from(message)
    assert message.calibration_id == "c"
    assert (back.degauss_steps, back.interpolation_error) == (100, 3e-10)
    for one, other in zip(book.recipes, back.recipes, strict=True):
        figures = [(each.shape, each.max_zernike, each.rms, each.maps, each.stamp_ns) for each in (one, other)]
        assert figures[0] == figures[1]
        for name in ("effective", "signals", "by_model"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_recipes_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(RecipeError, match="must be sorted"):
        RecipeBook((recipe(0.02), recipe(-0.01)), 100, 0.0)
    with pytest.raises(RecipeError, match="effective signals must be finite, one each"):
        RecipeBook((replace(recipe(-0.01), by_model=np.zeros(3)),), 100, 0.0)
    with pytest.raises(RecipeError, match="different numbers of actuators"):
        RecipeBook((recipe(-0.01), recipe(0.02, actuators=3)), 100, 0.0)
    with pytest.raises(RecipeError, match="max_zernike = nan m: must be finite and not negative"):
        RecipeBook((replace(recipe(-0.01), max_zernike=np.nan),), 100, 0.0)


INACTIVE, SHUT_DOWN = "pdm_driver is not active: activate it", "pdm_driver was shut down: start its process again"


@pytest.mark.parametrize(
    ("code", "message", "sentence"),
    [
        (ErrorCode.OK, "", "pdm_driver is not active"),
        (ErrorCode.OUT_OF_RANGE, "signals: refused", "pdm_driver is not active: signals: refused"),
        (ErrorCode.DRIVER_INACTIVE, INACTIVE, INACTIVE),
        (ErrorCode.DRIVER_INACTIVE, SHUT_DOWN, SHUT_DOWN),
    ],
)
def test_a_driver_on_its_way_to_the_safe_shape_is_called_inactive_once(
    code: ErrorCode, message: str, sentence: str
) -> None:
    safing = ActuatorState(driver_state=ActuatorState.STATE_SAFING, error_code=code, message=message)
    refusal = driver_refusal(safing)
    assert refusal is not None
    assert str(refusal) == sentence
