"""Faults around a real focus controller, between a real driver and many clients."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from dm_msgs.msg import ActuatorState, FocusRequest, FocusState
from dm_msgs.srv import SetFocus

from fault_injection.fault import FaultRecord, run_faults
from fault_injection.faults.registry import GROUPS, OTHERS, select
from fault_injection.rigs.common_steps import overtaken
from fault_injection.rigs.focus_rig import FocusRig

pytestmark = pytest.mark.processes

#: Those that nothing else in the tests shows; `./dm faults` runs all.
FAULTS = (
    "foreign_calibration",
    "calibration_vanishes",
    "driver_inactive",
    "driver_dies_in_move",
    "driver_stopped",
    "driver_gone_in_conditioning",
    "hundred_clients",
    "move_cancelled",
    "move_preempted",
    "cancel_after_newer_request",
    "conditioned_move_ended",
    "loop_cancelled",
)


@pytest.mark.parametrize("name", FAULTS)
def test_every_request_is_carried_out_or_refused_and_the_mirror_kept(name: str, tmp_path: Path, domain: int) -> None:
    (record,) = run_faults(select([name]), tmp_path, domain, seed=2012)
    assert record.harmless, str(record.figures())
    assert len(record.recovery_s) == record.injected


def test_a_dead_driver_is_known_and_what_nobody_carries_out_counts_as_lost(tmp_path: Path, domain: int) -> None:
    """Without `driver_timeout` too: liveliness says so; and a loss must be counted."""
    random, record = Random(1), FaultRecord("dead driver")
    with FocusRig(tmp_path, domain, driver_timeout=0.0) as rig:
        rig.refocus(random)
        planned = SetFocus.Request(request=FocusRequest(curvature=rig.curvature(random)), dry_run=True)
        answered = rig.begin(SetFocus, planned)
        rig.wait(answered.done, "the controller's answer", 20.0)
        rig.account_for(answered.result().state, record, patience_s=1.0)
        assert record.lost == 1
        assert "neither carried out nor told of" in record.remarks[0]
        rig.kill()
        rig.account_for(rig.set_focus(rig.curvature(random)), record, patience_s=4.0)
    assert record.lost == 1


@pytest.mark.parametrize(
    ("holder", "requested", "stamp", "by_another"),
    [("loop", 0.5, 2, True), ("loop", 0.1, 2, False), ("", 0.5, 2, False), ("loop", 0.5, 1, False)],
)
def test_only_who_holds_the_mirror_overtakes_a_request(
    holder: str, requested: float, stamp: int, by_another: bool
) -> None:
    state = FocusState(signals=[0.1] * 37)
    state.header.stamp.sec = 1
    report = ActuatorState(holder=holder, requested=[requested] * 37)
    report.header.stamp.sec = stamp
    assert overtaken([report], state) == by_another


def test_groups_stand_for_their_faults() -> None:
    assert select(["network"]) == list(GROUPS["network"])
    assert select([]) == [fault for faults in GROUPS.values() for fault in faults]
    assert select(["move_cancelled", "controller"])[0].name == "move_cancelled"
    assert len({fault.name for fault in select([])}) == len(select([]))
    assert not {fault.name for fault in select([])} & {*GROUPS, *OTHERS}
    with pytest.raises(ValueError, match=r"faults = flood: must be groups \(driver, .*soak\) or among .*late_joiner"):
        select(["flood"])
