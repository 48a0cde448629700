#!/usr/bin/env python3
"""Set up the environment of the deformable-mirror suite, build it when something changed, then run a command in it.

Standard library only: this file must start on a machine that has nothing but Python.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
ENVIRONMENT_STAMP = VENV / "dm-environment.json"
BUILD_STAMP = ROOT / "install" / "dm-build.json"
SUPPORTED_PYTHON = ((3, 11), (3, 13))

USAGE = """\
usage: ./dm COMMAND [OPTION ...]

The two commands to begin with
  demo       calibrate a virtual PDM30-37 over the real nodes, wire protocol and file formats, then focus it
  test       set everything up and run all checks: ruff, mypy, pytest

On the bench
  up         start the nodes (--config FILE: against hardware; without: with the virtual bench)
  calibrate  measure and store a calibration
  focus      ask for a curvature (or --dioptre): prediction first, then the move
  doctor     say what is missing or wrong, and how to cure it
  exec       run any command inside the environment: ./dm exec python my_script.py

Every command has --help, and --json FILE where it yields figures. Set-up runs by itself when it is needed.
"""


class SetupError(Exception):
    """Something this machine lacks, with the command that cures it."""


def say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def digest(paths: list[Path]) -> str:
    """Hash names and contents of files, so that an unchanged tree is recognised without running anything."""
    result = hashlib.sha256()
    for path in sorted(paths):
        result.update(str(path.relative_to(ROOT)).encode() + b"\0")
        result.update(path.read_bytes() if path.is_file() else b"")
    return result.hexdigest()


def sourced_jazzy() -> bool:
    """Whether the shell has sourced an apt (or source) installation of ROS 2 Jazzy."""
    if os.environ.get("ROS_DISTRO") != "jazzy" or not os.environ.get("AMENT_PREFIX_PATH"):
        return False
    return not os.environ["AMENT_PREFIX_PATH"].startswith(str(VENV))


# ---------------------------------------------------------------------------------------------------------------------
# What the machine must have


def missing_tools() -> list[tuple[str, str]]:
    """(what is missing, the command that installs it) for everything pip cannot bring."""
    missing = []
    low, high = SUPPORTED_PYTHON
    if not low <= sys.version_info[:2] <= high:
        missing.append(
            (
                f"Python {low[0]}.{low[1]} to {high[0]}.{high[1]} (this is {sys.version.split()[0]})",
                "sudo apt-get install python3.12 python3.12-venv python3.12-dev   # then: python3.12 ./dm ...",
            )
        )
    if not (shutil.which("g++") or shutil.which("c++")):
        missing.append(("a C++ compiler (g++)", "sudo apt-get install g++"))
    if not shutil.which("make") and not shutil.which("ninja") and sourced_jazzy():
        missing.append(("make or ninja", "sudo apt-get install make"))
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        version = f"{sys.version_info[0]}.{sys.version_info[1]}"
        missing.append(
            (
                f"the Python headers (Python.h in {sysconfig.get_path('include')})",
                f"sudo apt-get install python{version}-dev",
            )
        )
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        version = f"{sys.version_info[0]}.{sys.version_info[1]}"
        missing.append(("Python's venv module", f"sudo apt-get install python{version}-venv"))
    if not sourced_jazzy() and not (sys.platform == "linux" and os.uname().machine == "x86_64"):
        missing.append(
            (
                "ROS 2 Jazzy: its wheels exist for Linux on x86-64 only",
                "install ROS 2 Jazzy for this system, then: source /opt/ros/jazzy/setup.bash",
            )
        )
    return missing


def check_tools() -> None:
    missing = missing_tools()
    if missing:
        lines = [f"  {what}\n      {cure}" for what, cure in missing]
        raise SetupError("this machine lacks:\n" + "\n".join(lines))


# ---------------------------------------------------------------------------------------------------------------------
# The environment


def requirement_files() -> list[Path]:
    if sourced_jazzy():  # NumPy and SciPy must be the ones ROS was compiled against
        return [ROOT / "requirements" / "python.txt"]
    return [ROOT / "requirements" / "ros.txt", ROOT / "requirements" / "python.txt"]


def environment_key() -> str:
    return digest([*requirement_files(), ROOT / "dm"]) + sys.version + str(sourced_jazzy()) + str(ROOT)


def run_logged(command: list[str], log: Path, what: str, environment: dict[str, str] | None = None) -> None:
    """Run a set-up step with a one-line progress display; on failure show the end of its log."""
    started = time.monotonic()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, cwd=ROOT, env=environment)
        while True:
            try:
                status = process.wait(timeout=1)
                break
            except subprocess.TimeoutExpired:
                if sys.stderr.isatty():
                    print(f"\r{what} ... {time.monotonic() - started:.0f} s", end="", file=sys.stderr, flush=True)
    say(f"\r{what} ... {'done' if status == 0 else 'FAILED'} in {time.monotonic() - started:.0f} s")
    if status != 0:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-25:])
        raise SetupError(f"{what} failed (status {status}). The end of {log.relative_to(ROOT)}:\n{tail}")


def name_this_python(venv: Path) -> None:
    """The ROS wheels' CMake files name the Python of the machine they were built on; make them name this one."""
    import re

    include, library = sysconfig.get_path("include"), f"lib/python{sys.version_info[0]}.{sys.version_info[1]}"
    replacements = [
        (re.compile(r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+"), include),
        (re.compile(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages"), str(venv / library / "site-packages")),
    ]
    for path in (venv / "share").rglob("*.cmake"):
        text = changed = path.read_text(errors="surrogateescape")
        for pattern, replacement in replacements:
            changed = pattern.sub(lambda _match, value=replacement: value, changed)
        if changed != text:
            path.write_text(changed, errors="surrogateescape")


def set_up_environment() -> None:
    key = environment_key()
    if ENVIRONMENT_STAMP.is_file() and json.loads(ENVIRONMENT_STAMP.read_text()).get("key") == key:
        return
    check_tools()
    # A half-made environment is worthless, and one of other pins must not linger: begin anew.
    if VENV.exists():
        shutil.rmtree(VENV)
    log = ROOT / "log"
    extra = ["--system-site-packages"] if sourced_jazzy() else []
    run_logged([sys.executable, "-m", "venv", *extra, str(VENV)], log / "venv.log", "making .venv")
    arguments = [part for path in requirement_files() for part in ("-r", str(path))]
    if sourced_jazzy():
        arguments += ["-c", str(ROOT / "requirements" / "sourced-ros.txt")]
    run_logged(
        [str(VENV / "bin" / "pip"), "install", "--disable-pip-version-check", "--prefer-binary", *arguments],
        log / "pip.log",
        "installing pinned packages",
    )
    if not sourced_jazzy():
        name_this_python(VENV)
    ENVIRONMENT_STAMP.write_text(json.dumps({"key": key}))


# ---------------------------------------------------------------------------------------------------------------------
# The workspace


def build_key() -> str:
    """What needs a new colcon build when it changes.

    Python sources, launch and configuration files are linked into the install space: only the names of the latter count.
    """
    inputs = [path for path in (ROOT / "src" / "dm_msgs").rglob("*") if path.is_file()]
    names = []
    for package in (ROOT / "src").iterdir():
        inputs += [package / name for name in ("package.xml", "setup.py", "setup.cfg") if (package / name).is_file()]
        names += [str(path) for folder in ("launch", "config") for path in (package / folder).rglob("*.*")]
    return digest(inputs) + hashlib.sha256("\0".join(sorted(names)).encode()).hexdigest()


def wheel_environment() -> dict[str, str]:
    environment = dict(os.environ)
    environment["PATH"] = f"{VENV / 'bin'}{os.pathsep}{environment.get('PATH', '')}"
    environment["VIRTUAL_ENV"] = str(VENV)
    if not sourced_jazzy():
        environment["AMENT_PREFIX_PATH"] = environment["CMAKE_PREFIX_PATH"] = str(VENV)
    return environment


def captured_environment() -> dict[str, str]:
    """What the set-up files of the workspace change, so that later runs need no shell."""
    script = f"source '{ROOT}/install/setup.bash' >/dev/null 2>&1; exec '{PYTHON}' -c 'import json,os;print(json.dumps(dict(os.environ)))'"
    before = wheel_environment()
    output = subprocess.run(["bash", "-c", script], env=before, check=True, capture_output=True, text=True).stdout
    after = json.loads(output)
    volatile = {"_", "PWD", "OLDPWD", "SHLVL"}
    original = dict(os.environ)
    return {key: value for key, value in after.items() if key not in volatile and original.get(key) != value}


def build_workspace() -> None:
    # The captured environment holds the paths of the shell that built; another shell must not be mistaken for it.
    shell = [os.environ.get(name, "") for name in ("PATH", "LD_LIBRARY_PATH", "PYTHONPATH")]
    key = build_key() + environment_key() + hashlib.sha256("\0".join(shell).encode()).hexdigest()
    if BUILD_STAMP.is_file() and json.loads(BUILD_STAMP.read_text()).get("key") == key:
        return
    check_tools()
    for package in (ROOT / "src").iterdir():  # stale links of moved files would survive a rebuild
        if (package / "setup.py").is_file():
            shutil.rmtree(ROOT / "build" / package.name, ignore_errors=True)
            shutil.rmtree(ROOT / "install" / package.name, ignore_errors=True)
    cmake = ["-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={PYTHON}"] + ([] if sourced_jazzy() else ["-GNinja"])
    run_logged(
        [str(PYTHON), "-m", "colcon", "build", "--symlink-install", "--base-paths", "src", "--cmake-args", *cmake],
        ROOT / "log" / "colcon.log",
        "building the workspace",
        wheel_environment(),
    )
    BUILD_STAMP.write_text(json.dumps({"key": key, "environment": captured_environment()}))


def run_environment() -> dict[str, str]:
    environment = {**os.environ, **json.loads(BUILD_STAMP.read_text())["environment"]}
    # Nodes of a bench talk on this machine only unless the user opens it.
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    profile = ROOT / "src" / "dm_controller" / "config" / "fastdds.xml"
    environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    environment.setdefault("PYTHONUNBUFFERED", "1")
    environment["DM_ROOT"] = str(ROOT)
    return environment


def main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0 if arguments else 2
    command, rest = arguments[0], arguments[1:]
    try:
        if command == "doctor" and missing_tools():
            check_tools()  # the full doctor needs the environment; without a compiler this is its answer
        set_up_environment()
        build_workspace()
    except SetupError as error:
        say(f"./dm: {error}")
        return 1
    except KeyboardInterrupt:
        say("./dm: interrupted; run the same command again to go on")
        return 130
    environment = run_environment()
    if command == "exec":
        if not rest:
            say("./dm exec: give a command to run, for example: ./dm exec python")
            return 2
        target = shutil.which(rest[0], path=environment["PATH"])
        if target is None:
            say(f"./dm exec: no command named {rest[0]!r} in the environment")
            return 127
        os.execve(target, rest, environment)
    os.execve(str(PYTHON), [str(PYTHON), "-m", "dm_controller.cli", command, *rest], environment)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
