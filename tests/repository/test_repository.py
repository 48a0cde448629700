"""Rules of the repository itself: imports, packages, configuration, interfaces, the set-up script."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from rclpy.lifecycle import LifecycleNode

from dm_bringup.nodes import NODES
from dm_bringup.suite import load_config
from dm_common.ros.parameters import REQUIRED
from studies.documentation.parameters import TABLES, parameters_page

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src"

_NODES = {"dm_msgs", "dm_common"}
_INSTALLED = _NODES | {
    "dm_driver",
    "dm_simulation",
    "dm_calibration",
    "dm_controller",
    "dm_client",
    "dm_autofocus",
    "dm_bringup",
}
#: What each package may import of the others (docs/architecture.md).
ALLOWED = {
    "dm_common": {"dm_msgs"},
    "dm_driver": _NODES,
    "dm_simulation": _NODES,
    "dm_calibration": _NODES,
    "dm_controller": _NODES,
    "dm_client": _NODES,
    "dm_autofocus": _NODES | {"dm_client"},
    "dm_bringup": _INSTALLED - {"dm_bringup"},
    "dm_tools": _INSTALLED,
}


@cache
def imported(path: Path) -> set[str]:
    """Full names of all modules a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_go_one_way(package: str) -> None:
    for path in (SOURCE / package / package).rglob("*.py"):
        others = {name.split(".")[0] for name in imported(path)} & (ALLOWED.keys() | {"dm_msgs"}) - {package}
        assert others <= ALLOWED[package], f"{path.relative_to(ROOT)} imports {others - ALLOWED[package]}"


@pytest.mark.parametrize("package", [*ALLOWED])
def test_a_packages_own_tests_need_that_package_and_below_only(package: str) -> None:
    """Helper modules of tests count: those of this package and of those below it are within reach."""
    ours = ALLOWED.keys() | {"dm_msgs", "studies", "fault_injection"}
    helpers = {path.stem for other in [ROOT / "tests", *SOURCE.glob("*/test")] for path in other.glob("*.py")}
    below = ALLOWED[package] | {package}
    reach = below | {path.stem for name in below for path in (SOURCE / name / "test").glob("*.py")}
    for path in (SOURCE / package / "test").rglob("*.py"):
        others = {name.split(".")[0] for name in imported(path)} & (ours | helpers)
        assert others <= reach, f"{path.relative_to(ROOT)} imports {others - reach}"


#: rosdep's names of modules; ROS packages go by their own.
KEYS = {
    **{
        name: f"python3-{name}"
        for name in (
            *("h5py", "hypothesis", "matplotlib", "numpy", "pytest", "reportlab"),
            *("rich", "scipy", "serial", "typer", "yaml"),
        )
    },
    "PIL": "python3-pil",
}
#: Modules that rosdep does not know; the package's README, or the test that needs one, says how to install them.
#: Starlette comes with NiceGUI, backports.zstd with rosbags.
WITHOUT_KEY = {"nicegui", "starlette", "rosbags", "backports", "statsmodels", "Pyro4", "microscope"}


@pytest.mark.parametrize("package", [path.name for path in SOURCE.iterdir() if (path / "package.xml").is_file()])
def test_packages_declare_what_they_import(package: str) -> None:
    tree = ElementTree.parse(SOURCE / package / "package.xml").getroot()
    declared = {element.text for element in tree if element.tag.endswith("depend")}
    assert tree.findtext("name") == package
    assert tree.findtext("license") == "Apache-2.0"
    used = set()
    for folder in (package, "launch", "test"):
        for path in (SOURCE / package / folder).rglob("*.py"):
            used |= {name.split(".")[0] for name in imported(path)}
    helpers = {path.stem for path in SOURCE.glob("*/test/*.py")}  # which of them: see above
    used -= {package, *WITHOUT_KEY, *helpers, *sys.stdlib_module_names}
    needed = {KEYS.get(name, name) for name in used}
    assert needed <= declared
    if package not in ("dm_msgs", "dm_bringup"):  # which need generators, and the nodes that are started
        assert declared <= needed


def test_package_files_are_valid_and_agree_on_version_and_contact() -> None:
    """As the build farm reads them; `setup.py` takes both from there."""
    package = pytest.importorskip("catkin_pkg.package")
    warnings: list[str] = []
    files = [*SOURCE.glob("*/package.xml"), ROOT / "examples" / "cpp" / "package.xml"]
    known = [package.parse_package(str(path), warnings=warnings) for path in files]
    assert len(known) == 11 and not warnings
    people = {(each.version, who.name, who.email) for each in known for who in (*each.maintainers, *each.authors)}
    assert len(people) == 1 and {tuple(each.licenses) for each in known} == {("Apache-2.0",)}
    for path in SOURCE.glob("*/setup.py"):
        assert "@" not in path.read_text() and "version=package" in path.read_text(), path
    (distribution,) = importlib.metadata.distributions(name="dm_driver", path=[str(ROOT / "build" / "dm_driver")])
    assert distribution.metadata["Maintainer-email"] == known[0].maintainers[0].email


#: What messages of others hold.
STANDARD = {
    "std_msgs/Header": ["stamp", "sec", "nanosec", "frame_id"],
    "builtin_interfaces/Time": ["sec", "nanosec"],
}


def expanded(name: str, nested: bool = False) -> list[str]:
    """An interface as `ros2 interface show` shows it: nested messages in place of their names, without comments."""
    lines = []
    for line in (SOURCE / "dm_msgs" / name).read_text().splitlines():
        if nested and not line.partition("#")[0]:
            continue
        lines.append(line.partition("#")[0] if nested else line)
        kind = line.partition(" ")[0].partition("[")[0]
        lines += STANDARD.get(kind, [])
        if (SOURCE / "dm_msgs" / "msg" / f"{kind}.msg").is_file():
            lines += ["\t" + each for each in expanded(f"msg/{kind}.msg", True)]
    return lines


@pytest.mark.parametrize(
    "path", sorted((SOURCE / "dm_msgs").glob("*/*.[msa]*")), ids=lambda path: path.relative_to(SOURCE).as_posix()
)
def test_an_interface_is_shown_on_one_screen(path: Path) -> None:
    lines = expanded(path.relative_to(SOURCE / "dm_msgs").as_posix())
    assert len(lines) <= 57  # of a terminal on a screen of 1080 lines
    assert max(map(len, lines)) <= 150


def test_requests_ask_for_names_where_there_are_some() -> None:
    """Numbers stand for names in what is published only, where a person need not type them."""
    for path in [*(SOURCE / "dm_msgs").glob("srv/*"), *(SOURCE / "dm_msgs").glob("action/*")]:
        request = "\n".join(expanded(path.relative_to(SOURCE / "dm_msgs").as_posix())).partition("\n---")[0]
        assert "uint8" not in request, path.name


@pytest.mark.parametrize("name", ["bench.yaml", "hardware.yaml", "mirror_19.yaml", "membrane_37.yaml"])
def test_shipped_configurations_name_only_parameters_that_exist(name: str) -> None:
    config = load_config(SOURCE / "dm_bringup" / "config" / name)
    for node, values in config.items():
        known = {parameter.name: parameter for parameter in TABLES[node]}
        for parameter, value in values.items():
            assert parameter in known, f"{name}: {node} has no parameter {parameter}"
            known[parameter].check(value)
            if known[parameter].value.kind is float and not known[parameter].value.many:
                assert isinstance(value, float), f"{name}: {node}.{parameter} must be written with a point"
    required = {parameter.name for parameter in TABLES["pdm_driver"] if parameter.default is REQUIRED}
    assert required <= config["pdm_driver"].keys()


def test_the_parameter_page_is_what_the_code_says() -> None:
    assert (ROOT / "docs" / "parameters.md").read_text() == parameters_page()


@pytest.mark.parametrize(
    "path", sorted((SOURCE / "dm_msgs").glob("*/*.[msa]*")), ids=lambda path: path.relative_to(SOURCE).as_posix()
)
def test_every_number_in_an_interface_is_explained(path: Path) -> None:
    for line in path.read_text().splitlines():
        declaration, _, comment = line.partition("#")
        if re.match(r"(float|u?int)\d+", declaration) and "=" not in declaration:
            assert comment.strip(), f"{path.name}: {declaration}"


def test_the_registry_names_what_the_packages_offer() -> None:
    for node in NODES:
        setup = (SOURCE / node.package / "setup.py").read_text()
        assert f'"{node.name} = {node.module}:main"' in setup
        assert node.load_parameters()
        assert issubclass(node.load_class(), LifecycleNode) == node.lifecycle


def bare_machine(tmp_path: Path, *tools: str) -> tuple[Path, dict[str, str]]:
    """A copy of the set-up script on a machine that has only `tools`."""
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    shutil.copy(ROOT / "dm", checkout / "dm")
    shutil.copytree(ROOT / "requirements", checkout / "requirements")
    (checkout / "src" / "dm_msgs").mkdir(parents=True)
    programs = tmp_path / "bin"
    programs.mkdir()
    for tool in tools:
        (programs / tool).symlink_to(shutil.which(tool) or pytest.skip(f"no {tool} here"))
    return checkout, {"PATH": str(programs), "HOME": str(tmp_path)}


def test_a_missing_compiler_is_named_with_its_cure(tmp_path: Path) -> None:
    checkout, environment = bare_machine(tmp_path, "bash")
    done = subprocess.run(
        [sys.executable, str(checkout / "dm"), "demo"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "C++ compiler" in done.stderr
    assert "sudo apt-get install g++" in done.stderr
    assert not (checkout / ".venv").exists()


def test_a_folder_in_which_cmake_cannot_build_is_named_before_anything_is_installed(tmp_path: Path) -> None:
    (place := tmp_path / "Prüfstand").mkdir()
    checkout, environment = bare_machine(place)
    done = subprocess.run([sys.executable, checkout / "dm", "up"], env=environment, capture_output=True, text=True)
    assert done.returncode == 1 and f"CMake cannot build in {checkout}" in done.stderr


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    checkout, environment = bare_machine(tmp_path)
    (checkout / ".dm-lock").mkdir()
    done = subprocess.run([sys.executable, checkout / "dm", "up"], env=environment, capture_output=True, text=True)
    assert (done.returncode, "Traceback" in done.stderr) == (1, False)
    assert str(checkout / ".dm-lock") in done.stderr


def test_what_is_interrupted_or_from_elsewhere_is_not_taken_for_ready(tmp_path: Path) -> None:
    place = tmp_path / "O'Neill's bench"
    place.mkdir()
    checkout, _ = bare_machine(place)
    names = runpy.run_path(str(checkout / "dm"))["main"].__globals__
    stamp, built = checkout / "install" / "dm-build.json", checkout / "build" / "dm_msgs"
    built.mkdir(parents=True)
    stamp.parent.mkdir()
    (stamp.parent / "setup.bash").write_text("export ODD_PATH=/odd\n")
    names["PYTHON"].parent.mkdir(parents=True)
    names["PYTHON"].symlink_to(sys.executable)
    assert names["captured_environment"]()["paths"]["ODD_PATH"] == ["/odd"]
    (checkout / "src" / "dm_msgs" / "config").mkdir()
    stamp.write_text(json.dumps({"key": names["workspace_key"]()}))
    (checkout / "src" / "dm_msgs" / "config" / ".bench.yaml.swp").touch()
    assert names["workspace_is_ready"](), "an editor has a file open"
    stamp.write_text(stamp.read_text()[:40])
    assert not names["workspace_is_ready"]()

    (built / "of_a_file_that_was_renamed.yaml").symlink_to(checkout / "src" / "nothing.yaml")

    def interrupted(*_arguments: Any) -> None:
        assert not any(built.rglob("*")), "setuptools stops at a link to nothing"
        raise KeyboardInterrupt

    names |= {"run_logged": interrupted, "check_tools": lambda: None}
    for step in ("build_workspace", "set_up_environment"):
        with pytest.raises(KeyboardInterrupt):
            names[step]()
        assert not stamp.exists()
    assert not built.exists(), "it belongs to another environment, or folder"


def test_another_distribution_of_ros_does_not_stand_in_for_the_wheels(tmp_path: Path) -> None:
    if runpy.run_path(str(ROOT / "dm"))["sourced_jazzy"]():
        pytest.skip("there are no wheels here")
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "rclpy.py").write_text("raise ImportError('of another distribution')\n")
    other = {"ROS_DISTRO": "kilted", "AMENT_PREFIX_PATH": str(tmp_path), "PYTHONPATH": str(tmp_path / "lib")}
    subprocess.run(
        [sys.executable, str(ROOT / "dm"), "exec", "python", "-c", "import rclpy; rclpy.init()"],
        env=os.environ | other | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
        check=True,
    )


@pytest.mark.slow
def test_the_doctor_of_a_checkout_that_is_ready_asks_for_no_compiler() -> None:
    command = [sys.executable, str(ROOT / "dm"), "doctor", "--help"]
    subprocess.run(command, env=os.environ | {"PATH": ""}, check=True, capture_output=True)


def test_help_needs_no_set_up(tmp_path: Path) -> None:
    checkout, environment = bare_machine(tmp_path)
    done = subprocess.run(
        [sys.executable, str(checkout / "dm"), "--help"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0
    for command in ("demo", "test", "up", "calibrate", "focus", "doctor", "exec"):
        assert re.search(rf"^  {command} ", done.stdout, re.MULTILINE)
    assert not (checkout / ".venv").exists()


def test_exec_of_an_unknown_command_fails_clearly() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "dm"), "exec", "no-such-command"],
        capture_output=True,
        text=True,
        env=dict(os.environ),
    )
    assert done.returncode == 127
    assert "no-such-command" in done.stderr


def test_modules_that_workers_take_test_by_test_share_no_fixture() -> None:
    """They would make it once for every worker."""
    settings = runpy.run_path(str(ROOT / "conftest.py"))
    modules = {path.stem: path for folder in (SOURCE, ROOT / "tests") for path in folder.rglob("test_*.py")}
    assert {*settings["TEST_BY_TEST"], *settings["LONGEST"]} <= modules.keys()
    assert [name for name in settings["TEST_BY_TEST"] if "scope=" in modules[name].read_text()] == []
