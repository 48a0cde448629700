"""The codes that ROS-free code uses are those of the interface, and each expected failure has one."""

from __future__ import annotations

from dm_msgs.msg import ErrorCode as Message

from dm_common.errors import Cancelled, ErrorCode, MeasurementError, Refusal, UnknownNameError, error_code, unknown_name


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
