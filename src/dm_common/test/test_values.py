"""What fields of requests may be: one table, and the code and sentence of everything that is not."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from dm_msgs.msg import FocusState

from dm_common.errors import ErrorCode, Refusal
from dm_common.values import TEXT_MAX, Fields, fill_with_nan, real, reals, text, texts, whole

FIELDS = Fields(
    {
        "request.mode": text("", choices=("", "auto", "direct")),
        "settle_time": real(0.0, 0.1, 600.0, "s", zero="as configured"),
        "distance": real(0.0, 0.0, math.inf, "m", infinite=True),
        "dioptre": real(0.0),
        "maps": whole(0, 4, 100),
        "signals": reals([], -1.0, 1.0, sizes=(0, 3)),
        "method": text("", choices=("", "AZreg")),
        "labels": texts([], sizes=range(3)),
    }
)


def message(**changed: Any) -> Any:
    values = {
        "request": SimpleNamespace(mode=changed.pop("mode", "")),
        "settle_time": 0.0,
        "distance": math.inf,
        "dioptre": -1e9,
        "maps": 4,
        "signals": [],
        "method": "",
        "labels": ["p01"],
    }
    return SimpleNamespace(**values | changed)


@pytest.mark.parametrize("changed", [{}, {"signals": [0.0, -1.0, 1.0]}, {"settle_time": 600.0}, {"method": "AZreg"}])
def test_right_values_pass(changed: dict[str, Any]) -> None:
    FIELDS.check(message(**changed))


@pytest.mark.parametrize(
    ("changed", "code", "sentence"),
    [
        ({"mode": "7"}, ErrorCode.UNKNOWN_NAME, "request.mode = '7': must be one of empty, auto, direct"),
        (
            {"settle_time": -3.0},
            ErrorCode.OUT_OF_RANGE,
            "settle_time = -3.0: must be float, 0.1 to 600 s, or 0 (as configured)",
        ),
        ({"settle_time": 0.01}, ErrorCode.OUT_OF_RANGE, "settle_time = 0.01: must be float, 0.1 to 600 s"),
        ({"settle_time": math.nan}, ErrorCode.NOT_FINITE, "settle_time = nan: must be float, 0.1 to 600 s"),
        ({"settle_time": math.inf}, ErrorCode.NOT_FINITE, "settle_time = inf: must be"),
        ({"distance": math.nan}, ErrorCode.NOT_FINITE, "distance = nan: must be float, 0 to inf m"),
        ({"distance": -1.0}, ErrorCode.OUT_OF_RANGE, "distance = -1.0: must be"),
        ({"dioptre": -math.inf}, ErrorCode.NOT_FINITE, "dioptre = -inf: must be a finite float"),
        ({"maps": 3}, ErrorCode.OUT_OF_RANGE, "maps = 3: must be int, 4 to 100"),
        ({"signals": [0.0]}, ErrorCode.INVALID_LENGTH, "signals has 1 value: must have 0 or 3"),
        ({"signals": [4.0 / 3.0] * 3}, ErrorCode.OUT_OF_RANGE, "signals[0] = 1.33333: must be float[], -1 to 1; 2"),
        ({"signals": [0.0] * 4}, ErrorCode.INVALID_LENGTH, "signals has 4 values: must have 0 or 3"),
        ({"signals": [2.0, math.nan, 2.0]}, ErrorCode.NOT_FINITE, "signals[1] = nan: must be float[], -1 to 1"),
        ({"signals": [2.0, 0.0, 2.0]}, ErrorCode.OUT_OF_RANGE, "signals[0] = 2: must be float[], -1 to 1; 1 more"),
        ({"signals": [0.0, 0.0, 1.0000001]}, ErrorCode.OUT_OF_RANGE, "signals[2] = 1.0000001: must be float[], -1 to"),
        ({"method": "AZ"}, ErrorCode.UNKNOWN_NAME, "method = 'AZ': must be one of"),
        ({"method": "x" * 5000}, ErrorCode.INVALID_LENGTH, f"method has 5000 characters: must have at most {TEXT_MAX}"),
        ({"labels": ["a"] * 3}, ErrorCode.INVALID_LENGTH, "labels has 3 values: must have 0 to 2"),
        ({"labels": ["x" * 5000]}, ErrorCode.INVALID_LENGTH, "labels[0] has 5000 characters"),
        ({"labels": ["a\nb", "\x1b[31m"]}, ErrorCode.INVALID_ARGUMENT, r"labels[1] = '\x1b[31m': must hold no control"),
    ],
)
def test_wrong_values_are_named_with_what_is_allowed(changed: dict[str, Any], code: int, sentence: str) -> None:
    with pytest.raises(Refusal) as refused:
        FIELDS.check(message(**changed))
    assert refused.value.error_code == code
    assert sentence in str(refused.value)


def test_a_refused_message_holds_no_figures_that_look_like_values() -> None:
    state = fill_with_nan(FocusState(mode="direct"))
    assert math.isnan(state.predicted_rms) and math.isnan(state.curvature_min)
    assert state.mode == "direct" and state.header.stamp.sec == 0 and not state.signals
