"""The whole chain as separate processes: virtual bench, driver, interferometer, calibration, focus controller.

Ideal actuators and a seed that nothing was tuned on, so that the numeric bound judges the chain and not hysteresis.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import Calibrate
from dm_msgs.msg import ActuatorState, ErrorCode
from std_srvs.srv import SetBool

from dm_client import DeformableMirrorClient, DeformableMirrorError
from dm_common.ros.clients import ThreadedActionClient
from dm_common.ros.domains import own_domain
from dm_controller.planning.target import FocusTarget
from dm_tools.verify import map_of, surface_error
from fault_injection.rigs.forked_node import ForkedSuite
from support import bench_figures, fast_bench, wait_until

pytestmark = pytest.mark.processes

SEED = 20_11
WAVELENGTH = 632.8e-9


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("suite")


@pytest.fixture(scope="module")
def mirror(folder: Path) -> Iterator[DeformableMirrorClient]:
    """A client of the running suite."""
    config = fast_bench(folder, SEED)
    config["virtual_bench"]["interferometer.pixels"] = 472  # noise of coefficients far below what is asked for
    with (
        own_domain() as domain,
        ForkedSuite(config, folder, domain) as suite,
        DeformableMirrorClient(domain=domain, timeout_s=60.0) as client,
    ):
        try:
            client.wait_until_active()
        finally:
            suite.check()
        yield client


@pytest.fixture(scope="module")
def calibrated(mirror: DeformableMirrorClient) -> Calibrate.Result:
    """The full plan, once for all tests of this module."""
    before = mirror.capabilities
    assert before.quality == before.UNCALIBRATED
    feedback: list[Any] = []
    result = mirror.calibrate(Calibrate.Goal(activate=True), feedback.append)
    assert [item.step for item in feedback] == sorted(item.step for item in feedback)
    assert {item.phase for item in feedback} >= {"pokes", "surfaces"}
    assert mirror.wait(lambda: mirror.capabilities.calibration_id == result.id)
    return result


def measured_error(mirror: DeformableMirrorClient, curvature: float) -> Any:
    mirror.move_focus(curvature, settle_time=0.5)
    measurement, image = mirror.measure_map(f"{curvature:+.3f}")
    return surface_error(map_of(image), measurement.info, FocusTarget(curvature))


def test_focus_without_calibration_is_refused(mirror: DeformableMirrorClient) -> None:
    if mirror.capabilities.calibration_id:
        pytest.skip("already calibrated: run the whole module")
    with pytest.raises(DeformableMirrorError) as refused:
        mirror.focus(0.01)
    assert refused.value.error_code == ErrorCode.NOT_CALIBRATED


def test_calibration_is_good_and_stored(mirror: DeformableMirrorClient, calibrated: Calibrate.Result) -> None:
    assert calibrated.maps >= 69 + 74
    assert calibrated.maps_dropped == 0
    assert calibrated.poke_check_passed
    assert 0 < calibrated.in_sample_rms < calibrated.held_out_rms < 2e-9
    assert Path(calibrated.file).is_file()
    stored = mirror.list_calibrations()
    assert calibrated.id in stored.ids
    assert mirror.load_calibration(calibrated.id).id == calibrated.id


@pytest.mark.parametrize("curvature", [-0.05, -0.02, 0.0, 0.035, 0.05])
def test_measured_surface_is_the_requested_one(
    mirror: DeformableMirrorClient, calibrated: Calibrate.Result, curvature: float
) -> None:
    prediction = mirror.focus(curvature, dry_run=True)
    error = measured_error(mirror, curvature)
    assert error.max_zernike < WAVELENGTH / 500
    # The prediction knows what the actuators cannot make (print-through); the rest is the noise of one map.
    assert abs(error.rms - prediction.predicted_rms) < 1.5e-9


def test_closed_loop_ends_within_its_tolerance(mirror: DeformableMirrorClient, calibrated: Calibrate.Result) -> None:
    seen: list[Any] = []
    result = mirror.converge(0.03, tolerance=WAVELENGTH / 500, max_maps=3, on_feedback=seen.append)
    assert result.max_zernike <= WAVELENGTH / 500
    assert 1 <= result.maps <= 3
    wait_until(lambda: len(seen) >= result.maps, 10.0, "feedback")  # on another topic than the result
    assert len(seen) == result.maps
    assert measured_error(mirror, 0.03).rms == pytest.approx(result.residual_rms, abs=2e-9)


def test_beyond_reach_nothing_moves_and_the_range_is_named(
    mirror: DeformableMirrorClient, calibrated: Calibrate.Result
) -> None:
    mirror.move_focus(0.01)
    before = list(mirror.actuator_state.applied)
    with pytest.raises(DeformableMirrorError, match=r"reachable: -0\.\d+ to \+0\.\d+ 1/m") as refused:
        mirror.focus(0.5)
    assert refused.value.error_code == ErrorCode.UNREACHABLE
    time.sleep(0.6)  # more than the period of actuator_state
    assert list(mirror.actuator_state.applied) == before


def test_cancelled_calibration_leaves_the_mirror_at_mid_range(
    mirror: DeformableMirrorClient, calibrated: Calibrate.Result
) -> None:
    pokes: list[Any] = []
    server = ThreadedActionClient(mirror.node, Calibrate, "calibrate")
    wait_until(server.server_is_ready)
    time.sleep(0.5)
    accepted = server.send_goal_async(
        Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, skip_degauss=True), feedback_callback=pokes.append
    )
    wait_until(lambda: len(pokes) > 3)
    handle = accepted.result()
    handle.cancel_goal_async()
    result = handle.get_result_async()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.error_code == ErrorCode.CANCELED
    wait_until(lambda: not mirror.actuator_state.moving and not np.any(np.abs(mirror.actuator_state.applied) > 1e-3))
    assert mirror.capabilities.calibration_id == calibrated.id


def test_unplugged_electronics_are_noticed_and_their_return_too(
    mirror: DeformableMirrorClient, calibrated: Calibrate.Result
) -> None:
    mirror.move_focus(0.02)
    before = list(mirror.actuator_state.applied)
    power = mirror.node.create_client(SetBool, "virtual_bench/power")
    assert mirror.wait(power.service_is_ready)
    time.sleep(0.5)

    def switch(on: bool) -> None:
        done = power.call_async(SetBool.Request(data=on))
        wait_until(done.done)

    switch(False)
    wait_until(lambda: mirror.actuator_state.driver_state == ActuatorState.STATE_LINK_LOST)
    with pytest.raises(DeformableMirrorError) as refused:
        mirror.focus(-0.02)
    assert refused.value.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
    switch(True)
    wait_until(lambda: mirror.actuator_state.driver_state == ActuatorState.STATE_ACTIVE)
    assert list(mirror.actuator_state.applied) == before
    assert not mirror.actuator_state.history_known
    assert measured_error(mirror, 0.02).max_zernike < WAVELENGTH / 500


def test_the_electronics_never_saw_a_jump(mirror: DeformableMirrorClient, calibrated: Calibrate.Result) -> None:
    """The monitor in the emulated electronics watched every frame of this module."""
    values = bench_figures(mirror.node)
    assert int(values["frames"]) > 1000
    assert int(values["violations"]) == 0
    assert int(values["malformed_frames"]) == 0
    assert int(values["settings_frames"]) == 0
