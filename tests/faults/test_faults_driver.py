"""Faults around a real driver process, checked by the monitor in the emulated electronics."""

from __future__ import annotations

from pathlib import Path
from random import Random

import numpy as np
import pytest

from fault_injection.fault import Fault, FaultRecord, run_faults
from fault_injection.faults.driver_faults import REGISTRY, select
from fault_injection.rigs.driver_rig import DriverRig

pytestmark = pytest.mark.processes

#: Those that nothing else in the tests shows; `./dm faults` runs all.
FAULTS = (
    "driver_killed_in_move",
    "driver_interrupted_in_move",
    "driver_stopped_in_move",
    "unplugged_in_move",
    "unit_silent",
    "second_client",
    "serial_port_renamed",
    "command_flood",
    "senseless_commands",
    "clock_jumps",
)


@pytest.mark.parametrize("name", FAULTS)
def test_no_frame_breaks_a_limit_and_the_driver_recovers(name: str, tmp_path: Path, domain: int) -> None:
    (record,) = run_faults(select(name), tmp_path, domain, seed=2011)
    assert record.harmless, str(record.figures())
    assert len(record.recovery_s) == record.injected


def test_the_monitor_sees_the_step_of_a_driver_that_remembers_nothing(tmp_path: Path, domain: int) -> None:
    """What `state_folder` is for; and a harm that must be counted."""
    with DriverRig(tmp_path, domain, state_folder="") as rig:
        rig.recover(np.full(37, 0.5))
        assert rig.violations == 0
        rig.kill()
        rig.start()
        rig.recover(np.zeros(37))
        assert rig.violations == 1
        assert rig.bench.monitor.record.largest_jump == pytest.approx(1.5, abs=1e-3)


def test_a_fault_that_is_not_survived_counts_as_lost(tmp_path: Path) -> None:
    def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
        record.injected += 1
        raise RuntimeError("no recovery")

    (record,) = run_faults([Fault("bad", "", run)], tmp_path, 0)
    assert not record.harmless
    assert record.figures()["lost"] == 1 and "no recovery" in record.figures()["remarks"][0]


def test_unknown_faults_are_named() -> None:
    assert [fault.name for fault in select("")] == list(REGISTRY)
    with pytest.raises(ValueError, match=r"faults = flood: must be among .*command_flood"):
        select("flood,clock_jumps")
