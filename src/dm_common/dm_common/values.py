"""Allowed values of parameters and request fields: declared in tables, checked in one place. Independent of ROS."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dm_common import Floats
from dm_common.errors import ErrorCode, Refusal, beside, size_text

T = TypeVar("T")

#: Largest number of characters of a text in a parameter or request.
TEXT_MAX = 1000
#: Control characters that a terminal would execute: such texts appear in refusals and logs.
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Value:
    """Constraints on a value; made by `real`, `whole`, `text`, `switch`, and for arrays `reals`, `wholes`, `texts`.

    Attributes:
        kind: bool, int, float or str; for an array, that of its elements.
        default: the value when none is given.
        low, high: allowed range of numbers (of each element for arrays), inclusive.
        unit: SI unit, "" when it has none.
        choices: allowed strings.
        path: whether a string is a path, in which ~ must stand for an existing home folder.
        zero: meaning of 0, which is then allowed even outside the range; "" = no special meaning.
        infinite: whether infinity is allowed; NaN never is.
        many: whether it is an array.
        sizes: numbers of elements that an array may have.
    """

    kind: type
    default: Any
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    choices: tuple[str, ...] = ()
    path: bool = False
    zero: str = ""
    infinite: bool = False
    many: bool = False
    sizes: Sequence[int] = range(100_001)

    def allowed(self) -> str:
        """The allowed values as text, the type first."""
        if self.choices:
            return "one of " + ", ".join(choice or "empty" for choice in self.choices)
        kind = self.kind.__name__ + ("[]" if self.many else "")
        if math.isinf(self.low) and math.isinf(self.high):
            return f"a finite {kind}" if self.kind is float else f"a {kind}"
        zero = f", or 0 ({self.zero})" if self.zero else ""
        low, high = (f"{limit:{'g' if self.kind is float else '.10g'}}" for limit in (self.low, self.high))
        return f"{kind}, {low} to {high}{' ' + self.unit if self.unit else ''}{zero}"

    def check(self, name: str, given: Any) -> None:
        """Raise unless `given` is an allowed value of `name`; the message names both, and what is allowed.

        Raises:
            Refusal: NOT_FINITE, OUT_OF_RANGE (numbers), INVALID_LENGTH (arrays and texts), INVALID_ARGUMENT (control
                characters), UNKNOWN_NAME (choices, users in paths).
        """
        if self.many:
            self._check_array(name, given)
        elif self.kind is str:
            self._check_text(name, given)
        # First without NumPy: most numbers are right, and requests to the mirror wait for this check.
        elif not (self.low <= given <= self.high and (self.infinite or math.isfinite(given))):
            self._check_numbers(name, np.array([given], dtype=float), f"{name} = {given}")

    def _check_array(self, name: str, given: Any) -> None:
        size = len(given)
        if size not in self.sizes:
            between = " to " if isinstance(self.sizes, range) else " or "
            ends = (self.sizes[0], self.sizes[-1]) if isinstance(self.sizes, range) else self.sizes
            sizes = between.join(map(str, ends))
            raise Refusal(ErrorCode.INVALID_LENGTH, f"{size_text(name, size)}: must have {sizes}")
        if self.kind is str:
            for place, item in enumerate(given):
                self._check_text(f"{name}[{place}]", item)
        elif size:
            self._check_numbers(name, np.asarray(given, dtype=float), "")

    def _check_numbers(self, name: str, given: Floats, subject: str) -> None:
        """`subject`: name and value as given, for the message; "" = those of the first wrong element of an array."""
        right = (given >= self.low) & (given <= self.high) & (self.infinite | ~np.isinf(given))
        if self.zero:
            right |= given == 0.0
        if right.all():
            return
        # NaN and infinity are reported before values that are merely out of range.
        not_finite = ~right & ~np.isfinite(given)
        wrong = not_finite if not_finite.any() else ~right
        first, others = int(wrong.argmax()), int(wrong.sum()) - 1
        subject = subject or f"{name}[{first}] = {beside('.6g', given[first], self.low, self.high)}"
        raise Refusal(
            ErrorCode.NOT_FINITE if not_finite.any() else ErrorCode.OUT_OF_RANGE,
            f"{subject}: must be {self.allowed()}" + (f"; {others} more likewise" if others else ""),
        )

    def _check_text(self, name: str, given: str) -> None:
        if len(given) > TEXT_MAX:
            text = f"{name} has {len(given)} characters: must have at most {TEXT_MAX}"
            raise Refusal(ErrorCode.INVALID_LENGTH, text)
        if _CONTROL.search(given):
            raise Refusal(
                ErrorCode.INVALID_ARGUMENT,
                f"{name} = {given!r}: must hold no control characters but tabs and line ends",
            )
        if self.choices and given not in self.choices:
            raise Refusal(ErrorCode.UNKNOWN_NAME, f"{name} = {given!r}: must be {self.allowed()}")
        if self.path:
            try:
                Path(given).expanduser()
            except RuntimeError as error:
                text = f"{name} = {given!r}: must be a path; there is no home folder {Path(given).parts[0]}"
                raise Refusal(ErrorCode.UNKNOWN_NAME, text) from error


real, whole, text, switch = (partial(Value, kind) for kind in (float, int, str, bool))
reals, wholes, texts = (partial(Value, kind, many=True) for kind in (float, int, str))


def parameter(value: Value, description: str, live: bool = False, name: str = "") -> Any:
    """A field of a dataclass that is a parameter of a node as well, see `dm_common.ros.parameters.parameters_of`.

    Args:
        name: of the parameter; "" = that of the field.
    """
    default = tuple(value.default) if value.many else value.default
    return field(default=default, metadata={"value": value, "description": description, "live": live, "name": name})


#: A parameter that may change while the node runs.
live_parameter = partial(parameter, live=True)


def from_values(kind: type[T], values: Mapping[str, Any], prefix: str = "", **others: Any) -> T:
    """Make the dataclass `kind` from the `values` of its parameters, named with `prefix`, and from `others`."""
    own = {each.name: prefix + (each.metadata.get("name") or each.name) for each in fields(kind)}  # type: ignore[arg-type]
    given = {name: values[parameter] for name, parameter in own.items() if parameter in values}
    return kind(**{name: tuple(one) if isinstance(one, list) else one for name, one in given.items()} | others)


def check_parameters(of: Any) -> None:
    """Check the fields of a dataclass that are also parameters, as a node does. Raises Refusal naming the wrong one."""
    for each in fields(of):
        if "value" in each.metadata:
            each.metadata["value"].check(each.name, getattr(of, each.name))


def check_array(name: str, given: Any, shape: tuple[int, ...], finite: bool = True) -> None:
    """Raise ValueError unless `given` is an array of this `shape` and, if `finite`, of finite numbers, naming it."""
    if not isinstance(given, np.ndarray) or given.shape != shape:
        raise ValueError(f"{name} has the shape {np.shape(given)}: must be {shape}")
    if finite and not np.isfinite(given).all():
        raise ValueError(f"{name} holds values that are not finite")


class Fields:
    """Checks of all fields of a request or goal, by a table {name: allowed values}; dots lead into nested messages."""

    def __init__(self, table: Mapping[str, Value]) -> None:
        self._rules = [(name, attrgetter(name), value) for name, value in table.items()]

    def check(self, message: Any) -> None:
        """Raise Refusal naming the first field whose value is not allowed, that value, and what is allowed."""
        for name, get, value in self._rules:
            value.check(name, get(message))


def fill_with_nan(message: Any) -> Any:
    """Set all floats of `message`, nested ones too, to NaN: after a refusal none is known, and 0 would be a value."""
    for name, kind in message.get_fields_and_field_types().items():
        if kind == "double":
            setattr(message, name, math.nan)
        elif "/" in kind and not kind.startswith("sequence"):
            fill_with_nan(getattr(message, name))
    return message
