"""Size of the code and length of its paths: `python -m studies.house_figures [ROOT]`, `--json` for programs.

Uses the standard library only, and of this checkout nothing but what it measures, so it can measure another checkout:
run the file with that checkout's `./dm exec python`, from its root.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

MODULE_LINES = 300
#: Types that a surface map passes on its way from a file to the controller; each must still exist.
REPRESENTATIONS = (
    "SurfaceMap",
    "Measurement",
    "MapSet",
    "InfluenceFit",
    "Calibration",
    "InfluenceModel",
    "CalibratedMirror",
)
#: Script that prints the project's modules that the node loads, packages included.
LOADED = """
import json, sys
import dm_controller.focus_controller_node
print(json.dumps([name for name in sys.modules if name.split(".")[0] in sys.argv[1:]]))
"""
#: Script that passes a request to the node's subscription and prints our files entered until the command is published.
WALKED = """
import glob, json, os, sys, tempfile
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp()
sys.path[:0] = [sys.argv[1], os.path.join(sys.argv[1], "tests"), *glob.glob(os.path.join(sys.argv[1], "src/*/test"))]
import rclpy
from dm_msgs.msg import ActuatorState, FocusRequest
from rclpy.publisher import Publisher
import focus_bench
from dm_controller.focus_controller_node import FocusControllerNode

rclpy.init()
node = FocusControllerNode()
node.trigger_configure(), node.trigger_activate()
callbacks = {each.topic_name.rsplit("/", 1)[-1]: each.callback for each in node.subscriptions}
rest = [0.0] * 37
callbacks["mirror_info"](focus_bench.mirror_info())
callbacks["calibration"](focus_bench.calibration_with_history(focus_bench.make_law()))
state = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE, requested=rest, applied=rest, history_known=True)
state.header.stamp = node.get_clock().now().to_msg()
callbacks["actuator_state"](state)
files, calls, published = {}, [], []
source = os.path.realpath(os.path.join(sys.argv[1], "src"))

def profile(frame, event, _argument):
    if event != "call" or published:
        return
    code = frame.f_code
    if code is Publisher.publish.__code__ and frame.f_locals["self"].topic_name.endswith("actuator_command"):
        published.append(True)
        return
    path = os.path.realpath(code.co_filename)
    if path.startswith(source) and not code.co_name.startswith("<"):
        files[os.path.relpath(path, source)] = True
        calls.append(code.co_name)

sys.setprofile(profile)
callbacks["focus_request"](FocusRequest(curvature=0.02))
sys.setprofile(None)
print(json.dumps({"files": list(files) if published else None, "calls": len(calls)}))
node.destroy_node()
rclpy.shutdown()
"""


def packages_of(root: Path) -> dict[str, Path]:
    """Python packages of the workspace, by name, with their folders of code."""
    found = {path.parent.name: path.parent for path in root.glob("src/*/package.xml")}
    return {name: folder / name for name, folder in sorted(found.items()) if (folder / name / "__init__.py").is_file()}


def lines_of(paths: list[Path]) -> int:
    return sum(len(path.read_text().splitlines()) for path in paths)


def reach_of(root: Path) -> dict[str, set[str]]:
    """Packages of the workspace that each may use by its package.xml, directly or through others."""
    files = {path.parent.name: path for path in root.glob("src/*/package.xml")}
    direct = {
        name: {item.text for item in ElementTree.parse(path).getroot() if item.tag in ("depend", "exec_depend")}
        for name, path in files.items()
    }

    def reached(name: str, seen: set[str]) -> set[str]:
        for other in direct[name] & files.keys():
            if other not in seen:
                seen |= reached(str(other), seen | {str(other)})
        return seen

    return {name: reached(name, {name}) for name in files}


def tests_out_of_reach(root: Path) -> tuple[list[str], int]:
    """Test files of packages that import a package beyond their own's reach, or helpers of tests/; number of all files.

    Modules in a package's own test folder are within its reach.
    """
    packages, outside, count = reach_of(root), [], 0
    shared = {path.stem for path in (root / "tests").glob("*.py")} | {"fault_injection", "studies"}
    for name, reach in packages.items():
        folder = root / "src" / name / "test"
        own = {path.stem for path in folder.rglob("*.py")}
        for path in sorted(folder.rglob("test_*.py")):
            count += 1
            imported = set()
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    imported |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module:
                    imported.add(node.module.split(".")[0])
            if imported & ((set(packages) - reach) | (shared - own)):
                outside.append(str(path.relative_to(root)))
    return outside, count


def printed_by(script: str, *arguments: str) -> Any:
    """The last line that a script prints, as JSON, in a process of its own; None = it failed, which is shown."""
    done = subprocess.run([sys.executable, "-c", script, *arguments], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        print("not measured:", (done.stderr.strip().splitlines() or ["no message"])[-1], file=sys.stderr)
        return None
    return json.loads(done.stdout.strip().splitlines()[-1])


def figures_of(root: Path) -> dict[str, Any]:
    """All figures of the checkout at `root`."""
    packages = packages_of(root)
    modules = {name: sorted(folder.rglob("*.py")) for name, folder in packages.items()}
    lines = {name: lines_of(paths) for name, paths in modules.items()}
    every = [path for paths in modules.values() for path in paths] + sorted((root / "studies").rglob("*.py"))
    folders: dict[str, int] = {}
    for path in every:
        if path.name != "__init__.py":
            folder = str(path.parent.relative_to(root))
            folders[folder] = folders.get(folder, 0) + 1
    fullest = max(folders, key=lambda folder: folders[folder])
    long = [f"{path.relative_to(root)}: {lines_of([path])}" for path in every if lines_of([path]) > MODULE_LINES]
    loaded = printed_by(LOADED, *packages) or []
    walk = printed_by(WALKED, str(root)) or {"files": None, "calls": None}
    text = "\n".join(path.read_text() for path in every)
    outside, tests = tests_out_of_reach(root)
    return {
        "lines_of_dm_controller": lines.get("dm_controller", 0),
        "installed_lines": sum(lines.values()),
        "lines_by_package": lines,
        "modules_the_controller_loads": len(loaded),
        "of_them_from_dm_calibration": sum(name.split(".")[0] == "dm_calibration" for name in loaded),
        "modules_a_curvature_passes": len(walk["files"]) if walk["files"] is not None else None,
        "calls_of_a_curvature": walk["calls"],
        "walk_of_a_curvature": walk["files"],
        "representations_of_a_map": [name for name in REPRESENTATIONS if f"class {name}" in text],
        "fullest_folder": {fullest: folders[fullest]},
        "modules_over_300_lines": long,
        "package_tests": tests,
        "package_tests_out_of_reach": outside,
    }


def main() -> None:
    """Print the figures, one per line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).resolve().parents[1])
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    figures = figures_of(arguments.root.resolve())
    if arguments.json:
        print(json.dumps(figures, indent=1))
        return
    for name, value in figures.items():
        shown = f"{len(value)} " if isinstance(value, list) else ""
        print(f"{name.replace('_', ' ')}: {shown}{value}")


if __name__ == "__main__":
    main()
