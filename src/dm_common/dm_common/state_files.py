"""Files in which nodes keep their state for the next start."""

import hashlib
import os
import re
from pathlib import Path


def ros_home(place: str = "") -> Path:
    """$ROS_HOME, by default ~/.ros; or the path `place`, with $ROS_HOME for a leading ~/.ros, and ~ expanded."""
    usual = Path("~/.ros")
    path, home = Path(place or usual), os.environ.get("ROS_HOME")
    return (home / path.relative_to(usual) if home and path.is_relative_to(usual) else path).expanduser()


def file_stem(*names: object) -> str:
    """A file name made of `names`; if characters must be replaced, digits of their SHA-256 keep it unique."""
    joined = "_".join(map(str, names))
    stem = "_".join(re.sub(r"[^A-Za-z0-9._-]+", "-", str(name)).strip("-.") for name in names)[:200] or "mirror"
    return stem if stem == joined else f"{stem}-{hashlib.sha256(joined.encode()).hexdigest()[:8]}"


def state_file(folder: str, suffix: str, *names: object) -> Path | None:
    """The file for `names`, such as a serial number, in `folder`, a node's `state_folder`; None if that is empty."""
    return ros_home(folder) / f"{file_stem(*names)}{suffix}" if folder else None
