"""What no source of the suite may do, and parameters that must not lead out of their folder."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from dm_calibration.acquisition.acquisition import AcquisitionSettings

SOURCE = Path(__file__).resolve().parents[2] / "src"
FILES = [path for path in SOURCE.rglob("*.py") if "build" not in path.parts]
#: Run text as code, or rebuild objects from bytes.
CALLS = {"eval", "exec", "os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput", "yaml.load"}
MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
#: Where HDF5 files of others are opened: always from bytes in memory, in the process of
#: dm_calibration.store.hdf5_sandbox.
READERS = {"hdf5_image.py", "datx.py"}


def dotted(node: ast.expr) -> str:
    """`a.b.c` of a name or attribute; "" for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (value := dotted(node.value)):
        return f"{value}.{node.attr}"
    return ""


def offences(source: str) -> list[str]:
    """What in a module is not allowed."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MODULES:
            found.append(str(node.module))
        elif isinstance(node, ast.Call):
            if dotted(node.func) in CALLS:
                found.append(dotted(node.func))
            for keyword in node.keywords:
                value = keyword.value.value if isinstance(keyword.value, ast.Constant) else "not a constant"
                if (keyword.arg == "shell" and value is not False) or (keyword.arg == "allow_pickle" and value):
                    found.append(f"{keyword.arg}={value!r}")
    return found


@pytest.mark.parametrize(
    "source",
    [
        "eval('1')",
        "import os\nos.system('ls')",
        "import pickle",
        "from pickle import loads",
        "import subprocess\nsubprocess.run('ls', shell=True)",
        "import numpy as np\nnp.load('a', allow_pickle=True)",
        "import yaml\nyaml.load(text, Loader)",
    ],
)
def test_the_rule_finds_what_it_forbids(source: str) -> None:
    assert offences(source)


def test_no_code_from_text_no_pickle_no_shell() -> None:
    assert len(FILES) > 100
    assert {str(path.relative_to(SOURCE)): found for path in FILES if (found := offences(path.read_text()))} == {}


def test_files_of_others_are_opened_as_hdf5_in_the_sandbox_only() -> None:
    """External links and external storage need a file name; a file in memory has none."""
    users = {path for path in FILES if "h5py.File(" in path.read_text() and "test" not in path.parts}
    inside = {path for path in users if path.is_relative_to(SOURCE / "dm_calibration")}
    assert {path.name for path in inside} == READERS
    for path in inside:
        for line in path.read_text().splitlines():
            if "h5py.File(" in line:
                assert "io.BytesIO(" in line or "h5py.File(buffer" in line, f"{path.name}: {line.strip()}"


@pytest.mark.parametrize("suffix", ["/../../x.dat", "", "dat", "./x", ".d/x", ".dat\0", ".dat;rm"])
def test_the_trigger_writes_inside_the_watched_folder_only(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(ValueError, match="trigger_output_suffix"):
        AcquisitionSettings(tmp_path, ["*.dat"], 0.1, ["program", "{path}"], suffix)
    AcquisitionSettings(tmp_path, ["*.dat"], 0.1, ["program", "{path}"], ".tar.dat")
