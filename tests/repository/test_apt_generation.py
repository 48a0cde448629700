"""With ROS 2 Jazzy from apt the suite runs on the NumPy and SciPy of Ubuntu 24.04: some tests, under those."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GENERATION = ROOT / "runs" / "apt-generation"
REMEDY = "./dm exec python -m pip install --no-deps --target runs/apt-generation -r requirements/apt-generation.txt"
#: Without nodes: the hysteresis fit, what plans a move, and what else is computed of maps.
TESTED = (
    "tests/hysteresis/test_hysteresis_fit.py",
    "tests/hysteresis/test_hysteresis_control.py",
    "src/dm_common/test",
    "src/dm_calibration/test/test_drift_updates.py",
    "src/dm_calibration/test/test_influence_fit.py",
    "src/dm_calibration/test/test_ingest.py",
    "src/dm_calibration/test/test_instrument.py",
    "src/dm_calibration/test/test_phase_steps.py",
    "src/dm_controller/test",
    "src/dm_autofocus/test",
)


@pytest.mark.slow
@pytest.mark.skipif(not GENERATION.is_dir(), reason=f"no NumPy 1.26 beside the present one; run it with: {REMEDY}")
def test_what_is_computed_is_computed_with_the_libraries_of_ubuntu_too() -> None:
    path = os.pathsep.join(filter(None, (str(GENERATION), os.environ.get("PYTHONPATH", ""))))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment |= {"PYTHONPATH": path}
    command = [sys.executable, "-c", "import numpy, scipy; print(numpy.__version__, scipy.__version__)"]
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    assert found.split() == ["1.26.4", "1.11.4"]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not processes", *TESTED]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
