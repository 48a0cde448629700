"""Signals to the nodes above the driver, and faults of the network between driver and unit; `./dm faults` runs all."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from fault_injection.fault import run_faults
from fault_injection.faults import process_faults, wire_faults
from fault_injection.faults.wire_faults import Storm

pytestmark = pytest.mark.processes

FAULTS = {fault.name: fault for fault in (*process_faults.FAULTS, *wire_faults.FAULTS)}


def test_every_node_beside_the_driver_has_its_states() -> None:
    nodes = ("virtual_bench", "interferometer", "calibration", "focus_controller")
    states = {node: [fault.name for fault in process_faults.FAULTS if fault.name.startswith(node)] for node in nodes}
    assert {node: len(names) for node, names in states.items()} == dict(zip(nodes, (2, 3, 2, 4), strict=True))


@pytest.mark.parametrize(
    "name",
    [
        "interferometer_map_awaited",
        "calibration_in_run",
        "virtual_bench_measuring",
        "focus_controller_conditioning",
        "half_open",
        "udp_bad_network",
        "discovery_silent",
        "competing_publisher",
    ],
)
def test_no_frame_breaks_a_limit_and_everything_works_again(name: str, tmp_path: Path, domain: int) -> None:
    (record,) = run_faults([FAULTS[name]], tmp_path, domain, seed=2011)
    if record.skipped:
        pytest.skip(record.skipped)
    assert record.harmless, str(record.figures())
    assert len(record.recovery_s) >= 1


def test_the_bad_network_loses_doubles_and_reorders() -> None:
    storm = Storm(Random(2011))
    sent = [bytes([number // 256, number % 256]) for number in range(2000)]
    arrived = [datagram for each in sent for datagram in storm(each)]
    assert set(sent) - set(arrived)  # lost
    assert len(arrived) > len(set(arrived))  # doubled
    assert arrived != sorted(arrived)  # reordered
    assert 100 < storm.struck < 400
