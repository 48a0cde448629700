#!/usr/bin/env python3
"""Set up the environment of the deformable-mirror suite, build it when something changed, then run a command in it.

Standard library only: this file must start on a machine that has nothing but Python.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
#: Set by the shell's completion script, which asks for words and must get nothing else.
COMPLETION = "_DM_COMPLETE"
#: Raise when this script sets the environment up in another way, so that existing ones are made anew.
RECIPE = 1
ENVIRONMENT_STAMP = VENV / "dm-environment.json"
BUILD_STAMP = ROOT / "install" / "dm-build.json"
SUPPORTED_PYTHON = ((3, 11), (3, 13))

USAGE = """\
usage: ./dm COMMAND [OPTION ...]

The first hour
  up         start the nodes (--config FILE: against hardware; without: with the virtual bench)
  calibrate  measure and store a calibration with hysteresis and creep, 300 maps, seven minutes
  focus      ask for a curvature (or --dioptre): the promise first, then the move
  status     what runs, where the mirror stands, what it promises, what to do next

On the bench
  check      compare promise and map, and let the map improve the calibration
  flatten    as flat as the mirror can;  degauss  remove the hysteresis;  measure  take one map
  report     a page and a PDF of one calibration, to keep
  instrument  errors of the interferometer itself, from map files of flats, tilts or marks
  recipes    build conditioned recipes for a list of curvatures on the interferometer
  record     write what the nodes say to an MCAP file;  replay  plays it back
  console    a web page of the bench, on the loopback

On the simulation, with figures
  demo       calibrate a virtual PDM30-37 over the real nodes, wire protocol and file formats, then focus it
  compare    all solvers, open and closed loop, beside the fitting limit (--hysteresis: hysteresis and creep;
             --mirrors N: mirrors drawn at random)
  paper      the paper's tables and figures on one bench, as a page
  bench      how fast everything is, beside what one would use instead
  faults     faults injected into real processes: harm, loss, time to recover

  doctor     say what is missing or wrong, and how to cure it
  security   least-privilege policies of every node for SROS 2, written or checked
  exec       run any command inside the environment: ./dm exec python my_script.py
  test       set everything up and run all checks: ruff, mypy, pytest

Every command has --help, and --json FILE (- = standard output) where it yields figures. Set-up runs by itself.
Exit codes: 0 done; 1 refused or failed, the reason on standard error; 2 wrong usage; 3 the nodes are not running;
130 interrupted by Ctrl-C. --version says which version this is.
--install-completion makes the Tab key complete commands and options in your shell; --show-completion prints the script.
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
    return str(VENV) not in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)  # else this is a ./dm inside a ./dm exec


def forget_other_ros() -> None:
    """Leave the shell's other distribution of ROS 2 out of the search paths: it would stand in for the wheels."""
    os.environ.pop("RMW_IMPLEMENTATION", None)  # the wheels have but one
    others = tuple(filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    if str(VENV) in others:
        return  # this is a ./dm inside a ./dm exec
    os.environ.pop("COLCON_PREFIX_PATH", None)  # colcon would chain its workspaces to what it builds here
    for name in [name for name in os.environ if name.endswith("PATH") and name != "PATH"]:
        entries = os.environ[name].split(os.pathsep)
        os.environ[name] = os.pathsep.join(entry for entry in entries if not entry.startswith(others))


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
    if not str(ROOT).isascii():
        missing.append((f"a path of ASCII letters: CMake cannot build in {ROOT}", "move this folder"))
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
    return digest(requirement_files()) + str(RECIPE) + sys.version + str(sourced_jazzy()) + str(ROOT)


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
        (
            re.compile(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages"),
            str(venv / library / "site-packages"),
        ),
    ]
    for path in (venv / "share").rglob("*.cmake"):
        text = changed = path.read_text(errors="surrogateescape")
        for pattern, replacement in replacements:
            changed = pattern.sub(lambda _match, value=replacement: value, changed)
        if changed != text:
            path.write_text(changed, errors="surrogateescape")


def stamped(stamp: Path, key: str) -> bool:
    with contextlib.suppress(ValueError):  # cut off by a power failure: as good as none
        return stamp.is_file() and json.loads(stamp.read_text()).get("key") == key
    return False


def environment_is_ready() -> bool:
    return stamped(ENVIRONMENT_STAMP, environment_key())


def set_up_environment() -> None:
    key = environment_key()
    if environment_is_ready():
        return
    check_tools()
    # A half-made environment is worthless, and one of other pins must not linger: begin anew. What was built belongs
    # to the old one, and to the folder it was built in, which CMake writes to even from a copy elsewhere.
    if VENV.exists() or BUILD_STAMP.exists():  # else a build is somebody's own, by colcon without this script
        for folder in (ROOT / "build", ROOT / "install", VENV):
            if folder.is_symlink():
                folder.unlink()
            elif folder.exists():
                shutil.rmtree(folder)
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

    Python sources, launch and configuration files are linked into the install space: of these only names count, but
    not those of the files that an editor has beside one that is open.
    """
    inputs = [path for kind in ("msg", "srv", "action") for path in (ROOT / "src" / "dm_msgs" / kind).glob(f"*.{kind}")]
    names = []
    for package in (ROOT / "src").iterdir():
        described = ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt")
        inputs += [package / name for name in described if (package / name).is_file()]
        names += [str(path) for folder in ("launch", "config") for path in (package / folder).rglob("[!.]*.*")]
    return digest(inputs) + hashlib.sha256("\0".join(sorted(names)).encode()).hexdigest()


def wheel_environment() -> dict[str, str]:
    environment = dict(os.environ)
    environment["PATH"] = f"{VENV / 'bin'}{os.pathsep}{environment.get('PATH', '')}"
    environment["VIRTUAL_ENV"] = str(VENV)
    if not sourced_jazzy():
        environment["AMENT_PREFIX_PATH"] = environment["CMAKE_PREFIX_PATH"] = str(VENV)
    return environment


def captured_environment() -> dict[str, dict[str, object]]:
    """What the set-up files of the workspace change, so that later runs need no shell: values, and entries of paths."""
    dump = "import json,os;print(json.dumps(dict(os.environ)))"
    setup, python = shlex.quote(f"{ROOT}/install/setup.bash"), shlex.quote(str(PYTHON))
    script = f"source {setup} >/dev/null 2>&1; exec {python} -c '{dump}'"
    output = subprocess.run(["bash", "-c", script], env=wheel_environment(), check=True, capture_output=True, text=True)
    volatile = {"_", "PWD", "OLDPWD", "SHLVL"}
    values: dict[str, object] = {}
    paths: dict[str, object] = {}
    for name, value in json.loads(output.stdout).items():
        before = os.environ.get(name)
        if name in volatile or value == before:
            continue
        if name.endswith("PATH"):
            known = (before or "").split(os.pathsep)
            paths[name] = [entry for entry in value.split(os.pathsep) if entry and entry not in known]
        else:
            values[name] = value
    return {"values": values, "paths": paths}


def workspace_key() -> str:
    return build_key() + environment_key()


def workspace_is_ready() -> bool:
    return stamped(BUILD_STAMP, workspace_key())


def build_workspace() -> None:
    key = workspace_key()
    if workspace_is_ready():
        return
    check_tools()
    BUILD_STAMP.unlink(missing_ok=True)  # when this is interrupted, nothing is ready for the sources of before either
    for folder in ("build", "install"):  # links to files that were moved, renamed or removed: setuptools stops at them
        for link in (ROOT / folder).rglob("*"):
            if link.is_symlink() and not link.exists():
                link.unlink()
    cmake = ["-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={PYTHON}"] + ([] if sourced_jazzy() else ["-GNinja"])
    # By itself colcon lets a build wait for as long as the machine is busy with anything else.
    environment = {"MAKEFLAGS": f"-j{os.cpu_count() or 1}", **wheel_environment()}
    run_logged(
        [str(PYTHON), "-m", "colcon", "build", "--symlink-install", "--base-paths", "src", "--cmake-args", *cmake],
        ROOT / "log" / "colcon.log",
        "building the workspace",
        environment,
    )
    BUILD_STAMP.write_text(json.dumps({"key": key, "environment": captured_environment()}))


def run_environment() -> dict[str, str]:
    captured = json.loads(BUILD_STAMP.read_text())["environment"]
    environment = {**os.environ, **captured["values"]}
    for name, added in captured["paths"].items():
        present = [entry for entry in os.environ.get(name, "").split(os.pathsep) if entry and entry not in added]
        environment[name] = os.pathsep.join([*added, *present])
    # Nodes of a bench talk on this machine only unless the user opens it.
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment.setdefault("PYTHONUNBUFFERED", "1")
    bringup = ROOT / "src" / "dm_bringup"
    nodes = runpy.run_path(str(bringup / "dm_bringup" / "nodes.py"))
    for name, value in nodes["node_environment"](bringup / "config").items():
        environment.setdefault(name, value)
    environment["DM_ROOT"] = str(ROOT)
    # Studies and fault injection are not installed: they are used from the checkout.
    present = environment.get("PYTHONPATH", "").split(os.pathsep)
    checkout = [str(ROOT), str(ROOT / "tests")]
    environment["PYTHONPATH"] = os.pathsep.join(
        [*checkout, *(path for path in present if path and path not in checkout)]
    )
    return environment


@contextlib.contextmanager
def only_one() -> Iterator[None]:
    """Keep a second ./dm waiting while the first sets up or builds."""
    with (ROOT / ".dm-lock").open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            say("another ./dm is setting up; waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def main(arguments: list[str]) -> int:
    if not sourced_jazzy():
        forget_other_ros()
    if COMPLETION in os.environ:
        if not (environment_is_ready() and workspace_is_ready()):
            return 0  # no set-up at the press of a Tab key
        return os.execve(str(PYTHON), [str(PYTHON), "-m", "dm_tools"], run_environment())
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0
    command, rest = arguments[0], arguments[1:]
    try:
        if not (environment_is_ready() and workspace_is_ready()):
            with only_one():
                set_up_environment()
                build_workspace()
    except (SetupError, OSError, subprocess.SubprocessError) as error:  # a folder that is read-only, a full disk
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
    # A Ctrl-C waits until the command can answer it (`dm_tools.cli.run`), instead of ending in a traceback.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return os.execve(str(PYTHON), [str(PYTHON), "-m", "dm_tools", command, *rest], environment)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        say("./dm: interrupted")
        sys.exit(130)
