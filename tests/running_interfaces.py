"""The running nodes beside the profile: what one has that its policy does not allow, and the other way round."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

from dm_tools.security.interfaces import NodeInterface
from dm_tools.security.policy import Profile, full_name

_ACTION = "/_action/"
#: How rclpy asks for each kind of interface.
_QUESTIONS = {"publish": "publisher", "subscribe": "subscriber", "reply": "service", "request": "client"}


def interface_of(node: Any, name: str, ns: str) -> dict[str, set[str]]:
    """The interfaces of a running node by the rule that allows them, as full names; `node` is any rclpy node."""
    found: dict[str, set[str]] = {"execute": set(), "call": set()}
    for rule, kind in _QUESTIONS.items():
        listed = getattr(node, f"get_{kind}_names_and_types_by_node")(name, ns)
        found[rule] = {entry for entry, _types in listed if _ACTION not in entry}
        if rule in ("reply", "request"):
            actions = {entry.split(_ACTION)[0] for entry, _types in listed if _ACTION in entry}
            found["execute" if rule == "reply" else "call"] = actions
    return found


def differences(node: Any, name: str, profile: Profile, declared: NodeInterface) -> dict[str, list[str]]:
    """What a running node has beyond its declaration ("more"), and what it has not ("less"), as "rule name"."""
    more, less = [], []
    for rule, running in interface_of(node, name, profile.ns).items():
        allowed = {full_name(entry, profile.ns, name) for entry in getattr(declared, rule)}
        more += [f"{rule} {entry}" for entry in sorted(running - allowed)]
        less += [f"{rule} {entry}" for entry in sorted(allowed - running)]
    return {"more": more, "less": less}


def declaration_of(name: str, profile: Profile) -> NodeInterface | None:
    """The declaration that a running node's name falls under."""
    nodes = [node for group in profile.enclaves().values() for node in group]
    return next((node for node in nodes if fnmatchcase(name, node.name)), None)
