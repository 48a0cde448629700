"""Where nodes keep what they need at their next start."""

import hashlib
import os
import re
from pathlib import Path


def ros_home(place: str = "") -> Path:
    """$ROS_HOME, by default ~/.ros; or `place` with this in place of its ~/.ros, home folders spelled out."""
    usual = Path("~/.ros")
    path, home = Path(place or usual), os.environ.get("ROS_HOME")
    return (home / path.relative_to(usual) if home and path.is_relative_to(usual) else path).expanduser()


def file_stem(*names: object) -> str:
    """A file name for what `names` identify; those that are none are told apart by digits of their SHA-256."""
    told = "_".join(map(str, names))
    stem = "_".join(re.sub(r"[^A-Za-z0-9._-]+", "-", str(name)).strip("-.") for name in names)[:200] or "mirror"
    return stem if stem == told else f"{stem}-{hashlib.sha256(told.encode()).hexdigest()[:8]}"


def state_file(folder: str, suffix: str, *names: object) -> Path | None:
    """The file in `folder`, a node's `state_folder`, of what `names` identify; None for an empty folder name."""
    return ros_home(folder) / f"{file_stem(*names)}{suffix}" if folder else None
