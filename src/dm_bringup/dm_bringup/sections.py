"""The sections of a ROS 2 parameter file: how they are read, and which of them count for a node in a namespace."""

import re
from collections.abc import Mapping
from typing import Any

import yaml

#: In a parameter file: any number of namespaces, as the last part of a key every node below.
EVERY = "**"


class ConfigError(ValueError):
    """The configuration file cannot be used; the message says where and why."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that comes twice, of which YAML keeps the last; ROS takes both of two sections."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        if twice := [key for place, key in enumerate(keys) if key in keys[:place]]:
            raise yaml.constructor.ConstructorError(None, None, f"{twice[0]} comes twice", node.start_mark)
        return super().construct_mapping(node, deep)


def read_yaml(text: str) -> Any:
    """What a parameter file holds. Raises yaml.YAMLError."""
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def belongs(key: str, namespace: str) -> bool:
    """Whether the section `key` of a parameter file is for nodes in `namespace` ("" = any), with wildcards as in ROS.

    A name without a place, `pdm_driver`, is for any namespace here; to ROS it is for none.
    """
    place, _, name = key.strip("/").rpartition("/")
    steps = [*filter(None, place.split("/")), *([EVERY] if name == EVERY else [])]
    wild = {EVERY: "(/[^/]+)*", "*": "/[^/]+"}
    pattern = "".join(wild.get(step) or re.escape(f"/{step}") for step in steps)
    return not (namespace and steps) or re.fullmatch(pattern, f"/{namespace}") is not None


def values_in(sections: Mapping[str, Mapping[str, Any]], node: str, namespace: str) -> dict[str, Any]:
    """The values of a node in `namespace` ("" = any) of the sections of a file; of several the last counts, as to ROS.

    Raises:
        ConfigError: a general section comes after the particular one that it overrules.
    """
    found: dict[str, Any] = {}
    given: dict[str, str] = {}  # the section that counts, by parameter
    for key, values in sections.items():
        if key.rpartition("/")[2] not in (node, EVERY) or not belongs(key, namespace):
            continue
        for name, value in values.items():
            before = given.get(name, key)
            if name in found and found[name] != value and _particular(key) < _particular(before):
                text = f"{value!r} overrules {found[name]!r} of {before}, for the last counts: put {key} before it"
                raise ConfigError(f"{key}: {name}: {text}")
            found[name], given[name] = value, key
    return found


def _particular(key: str) -> int:
    """How few nodes a section is for: 0 = all, 1 = those of a name, 2 = one."""
    return 2 if "*" not in key else int(key.rpartition("/")[2] != EVERY)


def flat(section: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The parameters of a section by their names: `mirror: {serial: A}` is `mirror.serial: A` to ROS."""
    found: dict[str, Any] = {}
    for name, value in section.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found
