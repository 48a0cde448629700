"""Parameters declared once: type, default, unit, range and description in one table per node.

The table declares the parameters, checks every value (at start and on `ros2 param set`) and is the source of the
parameter pages of the documentation.
"""

import difflib
import math
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dm_common.errors import Refusal, unknown_name
from dm_common.values import Value, switch

#: ROS types, by the Python type of a value or of an array's elements, and whether it is an array.
_TYPES = {
    (bool, False): RosParameter.Type.BOOL,
    (int, False): RosParameter.Type.INTEGER,
    (float, False): RosParameter.Type.DOUBLE,
    (str, False): RosParameter.Type.STRING,
    (float, True): RosParameter.Type.DOUBLE_ARRAY,
    (int, True): RosParameter.Type.INTEGER_ARRAY,
    (str, True): RosParameter.Type.STRING_ARRAY,
}

#: Marks a parameter that the configuration must give.
REQUIRED = object()
#: A name this similar (0 to 1) to a known one is taken for a misspelling of it.
NEAR = 0.75


class ParameterError(ValueError):
    """A parameter is missing or out of its range; the message names it, its value and what is allowed."""


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
    def default(self) -> Any:
        return self.value.default

    def describe(self) -> str:
        """Description with unit and range, as `ros2 param describe` shows it."""
        described = self.description + (f" [{self.value.unit}]" if self.value.unit else "")
        if self.value.choices:
            described += f" One of: {', '.join(map(str, self.value.choices))}."
        return described

    def check(self, given: Any) -> Any:
        """The value of the parameter for `given`; a whole number is accepted for a float.

        Raises:
            ParameterError: the value is not allowed.
        """
        value = self.value
        many = isinstance(given, list | tuple | array)
        items = [
            float(item) if value.kind is float and type(item) is int else item for item in (given if many else [given])
        ]
        if many != value.many or any(type(item) is not value.kind for item in items):
            raise ParameterError(f"{self.name} = {given!r}: must be {self.value.allowed()}")
        checked = items if many else items[0]
        try:
            value.check(self.name, checked)
        except Refusal as refusal:
            raise ParameterError(str(refusal)) from refusal
        return checked

    @property
    def blank(self) -> Any:
        """Placeholder for a value that is missing or wrong: the default, or without one an empty text or NaN."""
        return ("" if self.value.kind is str else math.nan) if self.default is REQUIRED else self.default

    def as_ros(self, value: Any) -> RosParameter:
        """The ROS parameter with a value that `check` returned."""
        return RosParameter(self.name, _TYPES[self.value.kind, self.value.many], value)

    def descriptor(self, read_only: bool = False) -> ParameterDescriptor:
        value = self.value
        descriptor = ParameterDescriptor(
            name=self.name,
            type=_TYPES[value.kind, value.many].value,
            description=self.describe(),
            additional_constraints=value.allowed(),
            read_only=read_only,
        )
        bounded = not (value.many or (math.isinf(value.low) and math.isinf(value.high)))
        if value.kind is float and bounded:
            descriptor.floating_point_range = [FloatingPointRange(from_value=value.low, to_value=value.high)]
        if value.kind is int and bounded:
            low = 0 if value.zero else int(value.low)  # `check` refuses what lies between
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=int(value.high))]
        return descriptor


def parameters_of(prefix: str, config: Any) -> Iterator[Parameter]:
    """The parameters that fields of a dataclass declare by `dm_common.values.parameter`, in their order.

    `config` is the dataclass, or an object of it whose values are the defaults.
    """
    for each in fields(config):
        if each.metadata:
            value, default = each.metadata["value"], getattr(config, each.name)
            value = replace(value, default=list(default) if value.many else default)
            name = prefix + (each.metadata["name"] or each.name)
            yield Parameter(**{**each.metadata, "name": name, "value": value})


#: A parameter that may change while the node runs.
live = partial(Parameter, live=True)
#: Parameter of every lifecycle node.
AUTOSTART = Parameter("autostart", switch(True), "Configure and activate by itself after the start.")


class Values(dict[str, Any]):
    """Values of a node's parameters by name, as they are now.

    Attributes:
        problems: errors by parameter name, unknown names included; a wrong parameter has its default value.
    """

    def __init__(self) -> None:
        super().__init__()
        self.problems: dict[str, str] = {}

    def check(self) -> None:
        """Raise ParameterError naming every parameter that is missing, wrong or unknown."""
        if self.problems:
            raise ParameterError("; ".join(self.problems.values()))


class _RefusedParameterError(ParameterNotDeclaredException):
    """A refusal whose text rclpy gives as the answer, so the text must name the parameter."""

    def __init__(self, text: str) -> None:
        Exception.__init__(self, text)


def declare(
    node: Node,
    table: Sequence[Parameter],
    on_change: Callable[[Mapping[str, Any]], None] | None = None,
    locked: Callable[[], str] | None = None,
    check: Callable[[Mapping[str, Any]], None] = lambda changes: None,
) -> Values:
    """Declare every parameter of `table` on `node` and return their values by name.

    Every change is checked; accepted changes are entered in the returned values, then passed to `on_change`.

    Args:
        locked: for a lifecycle node: the transitions after which parameters that are not live may change; "" = they may
            now. If given, nothing is raised here: the node calls `Values.check` when it is configured, and errors can
            be corrected before that.
        check: raises ValueError for changes that contradict what the node has learnt meanwhile.

    Raises:
        ParameterError: naming every parameter that is missing, wrong or unknown.
    """
    by_name = {parameter.name: parameter for parameter in table}
    values = _declared(node, by_name)
    if locked is None:
        values.check()
        for parameter in table:
            if not parameter.live:
                node.set_descriptor(parameter.name, parameter.descriptor(read_only=True))

    def convert(changes: list[RosParameter]) -> list[RosParameter]:
        """Convert as `Parameter.check` does; a wrong value stays as it is and is refused later."""
        for change in changes:
            if not node.has_parameter(change.name):
                raise _RefusedParameterError(str(unknown_name("parameter", change.name, by_name)))
        return [_converted(by_name[item.name], item) if item.name in by_name else item for item in changes]

    def validate(changes: list[RosParameter]) -> SetParametersResult:
        try:
            for change in changes:
                if (parameter := by_name.get(change.name)) is None:
                    continue
                value = parameter.check(change.value)
                # An unchanged value may be set at any time: `ros2 param load` of a dump sets all parameters.
                first = "" if parameter.live or locked is None else locked()
                if first and value != values[change.name]:
                    state = "configured" if "cleanup" in first else "active"
                    command = f"ros2 lifecycle set {node.get_fully_qualified_name()} {first}"
                    raise ParameterError(f"{change.name} changes only while the node is not {state}: `{command}` first")
                check({change.name: value})
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(changes: list[RosParameter]) -> None:
        accepted = {change.name: change.value for change in changes if change.name in by_name}
        values.update(accepted)
        for name in accepted:
            values.problems.pop(name, None)
        if on_change is not None and accepted:
            on_change(accepted)

    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(apply)
    return values


def _declared(node: Node, known: Mapping[str, Parameter]) -> Values:
    """Declare the parameters of the table with the values that the configuration gives."""
    values = Values()
    # The only place where rclpy keeps the configured values, including names that nobody declares.
    given: Mapping[str, RosParameter] = node._parameter_overrides
    for name, parameter in known.items():
        value = parameter.default
        if name in given:
            value = given[name].value
            if parameter.value.many and not value:
                value = []  # ROS gives no value for an empty list
        try:
            if value is REQUIRED:
                raise ParameterError(f"{name} is required but missing: {parameter.describe().rstrip('.')}")
            values[name] = parameter.check(value)
        except ParameterError as error:
            values[name], values.problems[name] = parameter.blank, str(error)
        first = parameter.as_ros(values[name])
        # An array declared by its type alone has no value, which hides all others from `ros2 param dump`.
        node.declare_parameter(name, first.type_, parameter.descriptor(), ignore_override=True)
        node.set_parameters([first])
    for name in given:
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            _judge_unknown(node, name, known, values)
    return values


def frame_id(node: Node, configured: str) -> str:
    """The frame of the mirror: as configured, else `mirror` within the namespace of `node`."""
    return configured or f"{node.get_namespace()}/mirror".lstrip("/")


def _converted(parameter: Parameter, change: RosParameter) -> RosParameter:
    empty = parameter.value.many and change.type_ != RosParameter.Type.NOT_SET and not change.value
    try:
        return parameter.as_ros(parameter.check([] if empty else _numbers(parameter.value, change.value)))
    except ParameterError as error:
        if change.type_ == _TYPES[parameter.value.kind, parameter.value.many]:
            return change
        raise _RefusedParameterError(str(error)) from error  # rclpy's own message on a wrong type names no parameter


def _numbers(value: Value, given: Any) -> Any:
    """Convert `given` where YAML took floats for text, as it (and `ros2 param`) does with 3e-08."""
    if value.kind is not float:
        return given
    texts = given.strip("[]").split(",") if value.many and isinstance(given, str) else given
    with suppress(ValueError):
        if isinstance(texts, str):
            return float(texts)
        if isinstance(texts, list) and all(isinstance(text, str) for text in texts):
            return [float(text) for text in texts]
    return given


def _judge_unknown(node: Node, name: str, known: Mapping[str, Parameter], values: Values) -> None:
    """Judge a given parameter that is not declared: refuse one that can only be meant for this node, else warn.

    A file for all nodes (`/**:`) may contain parameters that are meant for others.
    """
    groups = {parameter.partition(".")[0] for parameter in known if "." in parameter}
    text = f"{node.get_name()}: {unknown_name('parameter', name, known)}"
    if ("." in name and name.partition(".")[0] in groups) or difflib.get_close_matches(name, known, 1, NEAR):
        values.problems[name] = text
    else:
        node.get_logger().warning(text)
