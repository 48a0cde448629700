"""The codes that ROS-free code uses are those of the interface, and each expected failure has one."""

from __future__ import annotations

import pytest
from dm_msgs.msg import ErrorCode as Message

from dm_common.errors import (
    Cancelled,
    ErrorCode,
    MeasurementError,
    Refusal,
    UnknownNameError,
    beside,
    error_code,
    size_text,
    unknown_name,
)


def test_codes_are_those_of_the_interface() -> None:
    constants = {name: getattr(Message, name) for name in dir(type(Message())) if name.isupper()}
    constants = {name: value for name, value in constants.items() if isinstance(value, int)}
    assert {code.name: int(code) for code in ErrorCode} == constants


def test_each_failure_has_its_code() -> None:
    assert error_code(Refusal(ErrorCode.BUSY, "another goal is running")) == 405
    assert error_code(MeasurementError(302, "no map within 5 s")) == 302
    assert error_code(Cancelled("cancelled")) == 500
    assert error_code(UnknownNameError("surface 'x' is unknown")) == 106
    assert error_code(ValueError("steps = 0")) == 107
    assert str(unknown_name("map label", "p01", [])) == "map label 'p01' is unknown"


@pytest.mark.parametrize(
    ("form", "value", "limits", "text"),
    [
        (".1%", 0.4, (0.5,), "40.0%"),
        (".1%", 0.49996, (0.5,), "49.996%"),
        ("+.4f", 0.05604, (-0.06, 0.0560349), "+0.05604"),
        ("+.4f", 0.05, (-0.06, 0.05), "+0.0500"),
        (".6g", 4.0 / 3.0, (-1.0, 1.0), "1.33333"),
        (".6g", 1.0000001, (-1.0, 1.0), "1.0000001"),
        (".6g", float("nan"), (-1.0, 1.0), "nan"),
    ],
)
def test_a_refused_value_is_told_from_its_limit(form: str, value: float, limits: tuple[float, ...], text: str) -> None:
    assert beside(form, value, *limits) == text


def test_the_size_of_an_array_agrees_with_its_noun() -> None:
    assert [size_text("signals", size) for size in (0, 1)] == ["signals has 0 values", "signals has 1 value"]
