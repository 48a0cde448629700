"""Fields that requests share, and conversion of Python values to fields: NumPy scalars, paths, lists of either."""

import operator
import os
from collections.abc import Callable
from typing import Any, TypedDict

from dm_client.connection import DeformableMirrorError
from dm_common.errors import ErrorCode, unknown_name


class Claim(TypedDict, total=False):
    """Options of every request that moves or holds the mirror, if somebody holds it (service `hold_mirror`).

    Attributes:
        holder: name of the client; requests of the client that holds the mirror are carried out.
        take_over: carry it out even if somebody else holds the mirror: they lose it, and their run ends.
    """

    holder: str
    take_over: bool


class FocusOptions(Claim, total=False):
    """Options of a request for a shape.

    Attributes:
        mode: "auto", "direct" or "conditioned", as in FocusRequest.
        time_budget: s within which the shape must be reached; 0 = as configured in the controller.
    """

    mode: str
    time_budget: float


def _text(value: Any) -> str:
    text = os.fspath(value)
    if not isinstance(text, str) or "\0" in text:  # a message would end at a NUL
        raise TypeError("bytes, or a NUL")
    text.encode()  # raises a ValueError for names of files that are not UTF-8
    return text


def _flag(value: Any) -> bool:
    if value not in (0, 1):  # rejects texts, which would always be true
        raise ValueError("neither true nor false")
    return bool(value)


#: What these types allow, for messages.
_ALLOWED = {"boolean": "true or false", "string": "string of UTF-8, no NUL"}
#: Conversion of a value to each of these types; raises TypeError, ValueError or OverflowError if it is not possible.
_CONVERTED: dict[str, Callable[[Any], Any]] = {
    "boolean": _flag,
    "double": float,
    "string": _text,
    **{f"{sign}int{bits}": operator.index for sign in ("", "u") for bits in (8, 16, 32, 64)},
}


def filled(kind: Any, **values: Any) -> Any:
    """A message, request or goal with these fields, converted to their types.

    rclpy ends the whole process if a value has another type, as the generated code asserts the types.

    Raises:
        DeformableMirrorError: INVALID_ARGUMENT or OUT_OF_RANGE, naming the field, its value and what it must be.
    """
    types = kind.get_fields_and_field_types()
    if unknown := values.keys() - types.keys():
        text = "; ".join(str(unknown_name("field", name, types)) for name in sorted(unknown))
        raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, text)
    return kind(**{name: _field(name, value, types[name]) for name, value in values.items()})


def _field(name: str, value: Any, type_name: str) -> Any:
    element = type_name.removeprefix("sequence<").rstrip(">")
    if element not in _CONVERTED:  # a message
        return value
    try:
        if element != type_name:
            if isinstance(value, str | bytes):
                raise TypeError("text")
            return [_one(name, each, element) for each in value]
        return _one(name, value, element)
    except (TypeError, ValueError, OverflowError) as error:
        text = f"{name} = {value!r}: must be {_ALLOWED.get(type_name, type_name)}"
        raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, text) from error


def _one(name: str, value: Any, type_name: str) -> Any:
    made = _CONVERTED[type_name](value)
    if "int" in type_name:
        bits = int(type_name.partition("int")[2])
        low, high = (0, 2**bits - 1) if type_name.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        if not low <= made <= high:
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, f"{name} = {made}: must be {low} to {high}")
    return made
