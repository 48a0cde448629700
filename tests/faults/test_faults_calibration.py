"""Faults around all real processes of a calibration, checked by the monitor in the emulated electronics."""

from __future__ import annotations

from pathlib import Path

import pytest

from fault_injection.fault import run_faults
from fault_injection.faults.calibration_faults import FAULTS

pytestmark = pytest.mark.processes

#: Those that nothing else in the tests shows; `./dm faults` runs all.
NAMES = ("calibration_power_cut", "calibration_interferometer_killed")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_harmed_lost_or_measured_twice(name: str, tmp_path: Path, domain: int) -> None:
    chosen = [fault for fault in FAULTS if fault.name == name]
    (record,) = run_faults(chosen, tmp_path, domain, seed=2011)
    assert record.harmless, str(record.figures())
