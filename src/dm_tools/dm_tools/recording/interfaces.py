"""Message types by name: their Python class, and their definition as text for readers that lack these types.

The text is rosbag2's: the definition, then each type it uses under a line of `=` and a line `MSG: package/Type`.
"""

import importlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

_SEPARATOR = "=" * 80
_FEEDBACK_MESSAGE = "FeedbackMessage"
_PARTS = {"Goal": 0, "Result": 1, "Feedback": 2}


class UnknownTypeError(ValueError):
    """No such message type in this environment; the message names it."""


@cache
def message_class(type_name: str) -> Any:
    """The class of ``package/msg/Type``, or of ``package/action/Type_FeedbackMessage``. Raises UnknownTypeError."""
    try:
        package, kind, name = type_name.split("/")
        module = importlib.import_module(f"{package}.{kind}")
        if kind == "action":
            action, part = name.rsplit("_", 1)
            owner = getattr(module, action)
            return getattr(owner if part in _PARTS else owner.Impl, part)
        return getattr(module, name)
    except (ValueError, ImportError, AttributeError) as error:
        raise UnknownTypeError(f"message type {type_name}: not installed here") from error


@cache
def definition(type_name: str) -> str:
    """The definition of a message type with all it uses, in the format `ros2msg`. Raises UnknownTypeError."""
    main, waiting = _text_and_types(type_name)
    done: dict[str, str] = {}
    while waiting:
        name = waiting.pop(0)
        if name not in done:
            package, _, stem = name.partition("/")
            kind = "action" if "_" in stem else "msg"  # part of an action
            text, used = _text_and_types(f"{package}/{kind}/{stem}")
            done[f"{package}/action/{stem}" if kind == "action" else name] = text
            waiting += used
    return "\n".join([main, *(f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in done.items())])


def _text_and_types(type_name: str) -> tuple[str, list[str]]:
    """The text of one type, and the ``package/Type`` of those it uses."""
    package, kind, name = type_name.split("/")
    fields = " ".join(message_class(type_name).get_fields_and_field_types().values())
    used = list(dict.fromkeys(re.findall(r"[a-z]\w*/\w+", fields)))
    action, _, part = name.rpartition("_")
    if part == _FEEDBACK_MESSAGE:
        # With its full name: readers look for a shorter one in different places.
        return f"unique_identifier_msgs/UUID goal_id\n{package}/action/{action}_Feedback feedback\n", used
    try:
        folder = Path(get_package_share_directory(package)) / kind
        if kind == "msg":
            return (folder / f"{name}.msg").read_text(), used
        return re.split(r"(?m)^---$", (folder / f"{action}.action").read_text())[_PARTS[part]], used
    except (OSError, PackageNotFoundError) as error:
        raise UnknownTypeError(f"message type {type_name}: its definition is not installed: {error}") from error
