"""What a goal is refused or ended for before anything moves."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import pytest
from dm_msgs.action import Autofocus
from dm_msgs.msg import Capabilities

from dm_autofocus.autofocus_parameters import PARAMETERS, search_config
from dm_autofocus.focus_probe import FocusProbe
from dm_autofocus.probe_action import range_of, ready_capabilities
from dm_common.errors import ErrorCode, Refusal


def test_a_mirror_that_reaches_nothing_is_not_focused() -> None:
    nothing = Capabilities(
        quality=Capabilities.CALIBRATED,
        curvature_min=math.nan,
        curvature_max=math.nan,
        error_code=ErrorCode.UNREACHABLE,
        message="no curvature is reachable",
    )
    probe = SimpleNamespace(controller=SimpleNamespace(missing=lambda: False), capabilities=nothing)
    with pytest.raises(Refusal, match="no curvature is reachable") as refused:
        ready_capabilities(cast(Any, probe))
    assert refused.value.error_code == ErrorCode.UNREACHABLE


def test_a_goal_that_was_cancelled_between_two_images_asks_for_no_other_shape() -> None:
    node = MagicMock()
    node.get_name.return_value = "autofocus"
    probe = FocusProbe(node, {"settle_time": 0.0, "stamp_lead": 0.0, "move_timeout": 1.0})

    def cancelled() -> None:
        raise Refusal(ErrorCode.CANCELED, "canceled; the mirror holds the shape it has")

    probe._check = cancelled
    with pytest.raises(Refusal, match="holds the shape it has"):
        probe.move(0.01)
    node.create_publisher().publish.assert_not_called()


@pytest.mark.parametrize(("low", "high"), [(0.05, 0.05), (0.05, -0.05), (math.nan, 0.05), (-math.inf, 0.05)])
def test_a_range_without_curvatures_is_refused(low: float, high: float) -> None:
    with pytest.raises(Refusal, match=r"range of curvatures = .* must be finite and rising") as refused:
        range_of(Autofocus.Goal(), Capabilities(curvature_min=low, curvature_max=high))
    assert refused.value.error_code == ErrorCode.OUT_OF_RANGE


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("search.tolerance", -1.0),
        ("search.coarse_step", 0.5),
        ("search.fine_points", 4),
        ("search.approach", -1.0),
        ("search.least_contrast", 1.0),
        ("track.dither", -1.0),
        ("track.drop", 1.0),
        ("track.patience", 0),
        ("track.wait", -1.0),
    ],
)
def test_a_senseless_search_is_refused(name: str, value: float) -> None:
    (parameter,) = (each for each in PARAMETERS if each.name == name)
    with pytest.raises(ValueError, match=f"{name} = {value}: must be "):
        parameter.check(value)


def test_a_short_range_is_swept_with_points_enough_to_tell_a_hill_from_noise() -> None:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    assert search_config(values, 0.011, 0.0, 1e-4).coarse_points == 11
    with pytest.raises(ValueError, match=r"aperture_radius = 0.0 m: must be above 0"):
        search_config(values, 0.0, 0.0, 0.01)


@pytest.mark.parametrize("tolerance", [1e-6, 2e-5, 0.06, 1.0])
def test_steps_that_do_not_suit_the_range_are_refused(tolerance: float) -> None:
    """With 1e-6 a search took gigabytes, with more than the range it ended after two images."""
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    with pytest.raises(ValueError, match=r"search.tolerance = .*: must be 2.5e-05 to 0.05 for a range of -0.0500"):
        search_config(values | {"search.tolerance": tolerance}, 0.011, -0.05, 0.05)
    assert search_config(values | {"search.tolerance": 1e-3}, 0.011, -0.05, 0.05).tolerance == 1e-3
