"""The sections of a ROS 2 parameter file: how they are read, and which of them apply to a node in a namespace."""

import re
from collections.abc import Mapping
from typing import Any

import yaml

#: Wildcard in the keys of a parameter file: any number of namespaces; as the last part of a key, every node below.
EVERY = "**"


class ConfigError(ValueError):
    """The configuration file cannot be used; the message says where and why."""


class _Loader(yaml.SafeLoader):
    """Reads 7e-3 and nan as numbers, y as true, 1:30 as text, as ROS does; refuses aliases and keys that come twice."""

    bool_values = yaml.SafeLoader.bool_values | {"y": True, "n": False}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            found = self.peek_event()
            raise yaml.composer.ComposerError(None, None, f"ROS reads no alias (*{found.anchor})", found.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        if twice := [key for place, key in enumerate(keys) if key in keys[:place]]:
            raise yaml.constructor.ConstructorError(None, None, f"{twice[0]} comes twice", node.start_mark)
        return super().construct_mapping(node, deep)


_NUMBERS = {
    "tag:yaml.org,2002:int": r"[-+]?(0[0-7]*|[1-9]\d*|0x[\da-fA-F]+)$",
    "tag:yaml.org,2002:float": r"[-+]?((\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$"
    r"|[-+]?(?i:inf|infinity|nan)$",
}
_Loader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0] not in (*_NUMBERS, "tag:yaml.org,2002:timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _form in _NUMBERS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(_form), [*"-+.0123456789iInN"])
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile("[yYnN]$"), [*"yYnN"])


def read_yaml(text: str) -> Any:
    """The content of a parameter file. Raises yaml.YAMLError."""
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def node_of(key: str) -> str:
    """The node to which the section `key` of a parameter file applies, in whatever namespace; EVERY = all nodes."""
    return key.rpartition("/")[2]


def belongs(key: str, namespace: str) -> bool:
    """Whether the section `key` of a parameter file applies in `namespace` ("" = any), with wildcards as in ROS.

    `pdm_driver` and `/pdm_driver` apply in any namespace here; in ROS they apply in the root namespace only.
    """
    return not namespace or re.fullmatch(_pattern(key), f"/{namespace}") is not None


def _pattern(key: str) -> str:
    """Regular expression of the namespaces in which a section applies."""
    wild = {EVERY: "(/[^/]+)*", "*": "/[^/]+"}
    return "".join(wild.get(step) or re.escape(f"/{step}") for step in _steps(key))


def _steps(key: str) -> list[str]:
    place, _, name = key.strip("/").rpartition("/")
    return [*filter(None, place.split("/")), *([EVERY] if name == EVERY else [])] or [EVERY]


def _covers(general: str, key: str) -> bool:
    """Whether the section `general` applies to all nodes to which `key` applies."""
    names = [node_of(each) for each in (general, key)]
    inside = "".join(f"/{step}" for step in _steps(key))
    return names[0] in (EVERY, names[1]) and re.fullmatch(_pattern(general), inside) is not None


def values_in(sections: Mapping[str, Mapping[str, Any]], node: str, namespace: str) -> dict[str, Any]:
    """The values of a node in `namespace` ("" = any) from the sections of a file; the last one counts, as in ROS.

    Raises:
        ConfigError: a section overrules an earlier one that applies to only some of its nodes.
    """
    found: dict[str, Any] = {}
    given: dict[str, str] = {}  # the section that counts, by parameter
    for key, values in sections.items():
        if node_of(key) not in (node, EVERY) or not belongs(key, namespace):
            continue
        for name, value in values.items():
            before = given.get(name, key)
            if found.get(name, value) != value and _covers(key, before) and not _covers(before, key):
                text = (
                    f"{value!r} overrules {found[name]!r} of {before}, since the last one counts: put {key} before it"
                )
                raise ConfigError(f"{key}: {name}: {text}")
            found[name], given[name] = value, key
    return found


def flat(section: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The parameters of a section by their names: `mirror: {serial: A}` is `mirror.serial: A` to ROS."""
    found: dict[str, Any] = {}
    for name, value in section.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found
