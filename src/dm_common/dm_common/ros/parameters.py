"""Parameters declared once: type, default, unit, range and description in one table per node.

The table declares the parameters, checks every value (at start and on `ros2 param set`) and is the source of the
parameter pages of the documentation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dm_common.mirror import APERTURE_TOLERANCE

_TYPES: dict[type | str, RosParameter.Type] = {
    bool: RosParameter.Type.BOOL,
    int: RosParameter.Type.INTEGER,
    float: RosParameter.Type.DOUBLE,
    str: RosParameter.Type.STRING,
    "float[]": RosParameter.Type.DOUBLE_ARRAY,
    "int[]": RosParameter.Type.INTEGER_ARRAY,
    "str[]": RosParameter.Type.STRING_ARRAY,
}

#: Marks a parameter that the configuration must give.
REQUIRED = object()


class ParameterError(ValueError):
    """A parameter is missing or out of its range; the message names it, its value and what is allowed."""


@dataclass(frozen=True)
class Value:
    """What a parameter may be; made by `real`, `whole`, `text`, `switch`, and for arrays `reals`, `wholes`, `texts`.

    Attributes:
        kind: bool, int, float, str, "float[]", "int[]" or "str[]".
        default: the value when none is given; REQUIRED when the configuration must give it; an empty list for arrays.
        low, high: allowed range of numbers (of each element for arrays), inclusive.
        unit: SI unit, "" when it has none.
        choices: allowed strings.
    """

    kind: type | str
    default: Any
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    choices: tuple[str, ...] = ()


real, whole, text, switch = (partial(Value, kind) for kind in (float, int, str, bool))
reals, wholes, texts = (partial(Value, kind) for kind in ("float[]", "int[]", "str[]"))


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Attributes:
        name: snake_case; dots group.
        value: its type, default and range.
        description: what it is, for a person.
        live: True when it may change while the node runs.
    """

    name: str
    value: Value
    description: str
    live: bool = False

    @property
    def kind(self) -> type | str:
        return self.value.kind

    @property
    def default(self) -> Any:
        return self.value.default

    def describe(self) -> str:
        """Description with unit and range, as `ros2 param describe` shows it."""
        described = self.description + (f" [{self.value.unit}]" if self.value.unit else "")
        if self.value.choices:
            described += f" One of: {', '.join(self.value.choices)}."
        return described

    def allowed(self) -> str:
        """The allowed values as text."""
        value = self.value
        if value.choices:
            return "one of " + ", ".join(value.choices)
        kind = value.kind if isinstance(value.kind, str) else value.kind.__name__
        if math.isinf(value.low) and math.isinf(value.high):
            return f"a {kind}"
        return f"{kind}, {value.low:g} to {value.high:g}{' ' + value.unit if value.unit else ''}"

    def check(self, given: Any) -> None:
        """Raise ParameterError when the value `given` is not allowed."""
        value = self.value
        if value.choices and given not in value.choices:
            raise ParameterError(f"{self.name} = {given!r}: must be {self.allowed()}")
        numbers = given if value.kind in ("float[]", "int[]") else [given] if value.kind in (int, float) else []
        for number in numbers:
            if not (math.isfinite(number) and value.low <= number <= value.high):
                raise ParameterError(f"{self.name} = {given!r}: must be {self.allowed()}")

    def descriptor(self) -> ParameterDescriptor:
        value = self.value
        descriptor = ParameterDescriptor(
            name=self.name,
            type=_TYPES[value.kind].value,
            description=self.describe(),
            additional_constraints=self.allowed(),
            read_only=not self.live,
        )
        bounded = not (math.isinf(value.low) and math.isinf(value.high))
        if value.kind is float and bounded:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=max(value.low, -1e308), to_value=min(value.high, 1e308))
            ]
        if value.kind is int and bounded:
            descriptor.integer_range = [
                IntegerRange(from_value=int(max(value.low, -(2**62))), to_value=int(min(value.high, 2**62)))
            ]
        return descriptor


#: Of every node that holds calibrations against the mirror.
APERTURE_PARAMETER = Parameter(
    "aperture_tolerance",
    real(APERTURE_TOLERANCE, 0.0, 0.5),
    "Largest relative difference between the aperture radius of maps or calibrations and the mirror's.",
    live=True,
)


def declare(
    node: Node,
    table: Sequence[Parameter],
    on_change: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Declare every parameter of `table` on `node` and return their values by name.

    Live parameters are checked on every set; accepted changes are put into the returned dictionary, then given to
    `on_change`.

    Raises:
        ParameterError: naming every required parameter that is missing, or the first value out of range.
    """
    values: dict[str, Any] = {}
    missing: list[Parameter] = []
    for parameter in table:
        default = _TYPES[parameter.kind] if parameter.default is REQUIRED else parameter.default
        if isinstance(default, list):  # rclpy cannot tell the type of an empty list
            default = default or _TYPES[parameter.kind]
        descriptor = parameter.descriptor()
        node.declare_parameter(parameter.name, default, descriptor)
        value = node.get_parameter_or(parameter.name).value
        if value is None:
            if parameter.default is REQUIRED:
                missing.append(parameter)
                continue
            value = list(parameter.default)
        elif isinstance(parameter.kind, str):
            value = list(value)
        parameter.check(value)
        values[parameter.name] = value
    if missing:
        names = "; ".join(f"{parameter.name} ({parameter.describe()})" for parameter in missing)
        raise ParameterError(f"{node.get_name()}: required parameters are missing from the configuration: {names}")

    by_name = {parameter.name: parameter for parameter in table}

    def validate(changes: list[RosParameter]) -> SetParametersResult:
        try:
            for change in changes:
                if change.name in by_name:
                    by_name[change.name].check(change.value)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(changes: list[RosParameter]) -> None:
        accepted = {change.name: change.value for change in changes if change.name in by_name}
        values.update(accepted)
        if on_change is not None and accepted:
            on_change(accepted)

    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply)
    return values
