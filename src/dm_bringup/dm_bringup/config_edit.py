"""Change values in a parameter file and leave everything else unchanged: comments, order, spelling."""

from collections.abc import Collection, Mapping
from typing import Any

import yaml

from dm_bringup.sections import EVERY, ConfigError, belongs, flat, node_of, read_yaml, values_in

Changes = Mapping[str, Mapping[str, Any]]


def edited(text: str, changes: Changes, namespace: str = "") -> str:
    """The parameter file `text` with the values of `changes`, {node: {parameter: value}}.

    Values are replaced where they are; new parameters come first in their section, a new section last in the file, both
    in the order of `changes`. In a file with sections of several mirrors, those of the mirror in `namespace` change.

    Raises:
        ConfigError: the text has a form that cannot be preserved, or a later section overrules a change. Nothing is
            lost by an edit.
    """
    expected, namespace = _sections(text), namespace.strip("/")
    try:
        for node, values in changes.items():
            key = _key(expected, node, namespace)
            expected[key] = expected.get(key, {}) | dict(values)
            for name, value in reversed(list(values.items())):  # each new one is inserted before the existing ones
                text = _with_value(text, key, name, value)
        kept = _sections(text) == expected
    except (yaml.YAMLError, ConfigError):  # nothing may be added after its end
        kept = False
    if not kept:
        raise ConfigError(f"this file cannot be changed without losing its form; put in by hand: {dict(changes)}")
    for node, values in changes.items():
        if not values.items() <= values_in(expected, node, namespace).items():
            raise ConfigError(f"a later section of this file overrules {dict(values)} of {node}: put them in by hand")
    return text


def _key(keys: Collection[str], node: str, namespace: str) -> str:
    """The section to change: if the file names namespaces, that of the mirror, new if necessary; else the node's."""
    of_node = [key for key in keys if node_of(key) == node and belongs(key, namespace)]
    if namespace and any({*key.split("/")[:-1]} - {"", "*", EVERY} for key in keys):  # other mirrors read common ones
        own = f"/{namespace}/{node}"
        return next((key for key in of_node if f"/{key.strip('/')}" == own), own)
    return ([key for key in of_node if "*" not in key] or of_node[-1:] or [f"/**/{node}"])[0]


def _with_value(text: str, key: str, name: str, value: Any) -> str:
    section, literal = _section(text, key), _literal(value)
    if section is None:
        return f"{text.rstrip()}\n\n{key}:\n  ros__parameters:\n    {name}: {literal}\n"
    for parameter, old in section.value:
        if parameter.value == name:
            start, end = old.start_mark, len(text[: old.end_mark.index].rstrip())  # a block of text ends a line below
            if isinstance(old, yaml.SequenceNode) and not old.flow_style:
                end = old.value[-1].end_mark.index
                items = value if isinstance(value, list | tuple) else ()
                # A list keeps one item per line; anything else is indented further than its name.
                literal = f"\n{' ' * start.column}".join(f"- {_literal(item)}" for item in items) or f"  {literal}"
            return text[: start.index] + literal + text[end:]
    if section.flow_style or not section.value:
        begin = section.start_mark.index + 1
        return f"{text[:begin]}{name}: {literal}{', ' if section.value else ''}{text[begin:]}"
    first = section.value[0][0].start_mark
    return f"{text[: first.index]}{name}: {literal}\n{' ' * first.column}{text[first.index :]}"


def _section(text: str, key: str) -> Any:
    """The YAML node of the parameters in the section `key`; None if there is none."""
    top = yaml.compose(text, yaml.SafeLoader)
    for title, content in top.value if top is not None else ():
        if title.value == key:
            return next(section for inner, section in content.value if inner.value == "ros__parameters")
    return None


def values_of(text: str) -> dict[str, dict[str, Any]]:
    """The values of a parameter file by node. Raises ConfigError."""
    return {node_of(key): values for key, values in _sections(text).items()}


def _sections(text: str) -> dict[str, dict[str, Any]]:
    try:
        content = read_yaml(text) or {}
        return {str(key): flat(section["ros__parameters"]) for key, section in content.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"not a parameter file: {type(error).__name__}: {error}") from error


def _literal(value: Any) -> str:
    """`value` on one line of YAML; texts that ROS would read as numbers are quoted."""
    for style in (None, '"'):
        text = yaml.safe_dump(value, default_flow_style=True, default_style=style, width=10**6)
        if read_yaml(text) == value:
            break
    return text.removesuffix("\n").removesuffix("\n...")
