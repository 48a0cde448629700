"""A mirror of 19 actuators on a framed serial unit, from its configuration file alone, through the real nodes.

Ideal actuators and a seed that nothing was tuned on: the bounds judge the chain and not hysteresis.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from dm_msgs.action import Calibrate
from dm_msgs.msg import ErrorCode

from dm_client import DeformableMirrorClient, DeformableMirrorError
from dm_common.limits import Limits
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import basis
from dm_common.ros.domains import own_domain
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.planning.target import FocusTarget
from dm_simulation.mirror.plate import Plate, PlateConfig, neighbour_pairs
from dm_tools.verbs.up import shared_config
from dm_tools.verify import map_of, surface_error
from fault_injection.rigs.forked_node import ForkedSuite
from support import bench_figures, fast_bench

pytestmark = pytest.mark.processes

SEED = 20_19
MIRROR_19 = shared_config("mirror_19.yaml")


@pytest.fixture(scope="module")
def mirror(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeformableMirrorClient]:
    """A client of the running suite."""
    folder = tmp_path_factory.mktemp("mirror_19")
    config = fast_bench(folder, SEED, MIRROR_19)
    config["virtual_bench"]["interferometer.pixels"] = 472  # its sag beyond the terms is steep
    config["calibration"]["updates.enable"] = False  # what is judged is this calibration, not what follows from maps
    with (
        own_domain() as domain,
        ForkedSuite(config, folder, domain) as suite,
        DeformableMirrorClient(domain=domain, timeout_s=60.0) as client,
    ):
        try:
            client.wait_until_active(60.0)
        finally:
            suite.check()
        yield client


@pytest.fixture(scope="module")
def calibrated(mirror: DeformableMirrorClient) -> Calibrate.Result:
    result = mirror.calibrate(Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, activate=True))
    assert mirror.wait(lambda: mirror.capabilities.calibration_id == result.id, 30.0)
    return result


def test_the_driver_tells_of_the_configured_mirror(mirror: DeformableMirrorClient) -> None:
    info = mirror.mirror_info
    assert (info.name, info.actuators, info.electronics) == ("PDM30-19", 19, "framed_serial")
    assert len(info.neighbour_a) == 42  # pairs on a hexagon of two rings
    assert np.hypot(info.actuator_x, info.actuator_y).max() == pytest.approx(14e-3)


def test_signals_arrive_through_the_frames(mirror: DeformableMirrorClient) -> None:
    signals = np.linspace(-0.4, 0.5, 19)
    mirror.set_signals(signals.tolist())
    # 14 bits over 400 V of which 300 are used: half a step is 8e-5 of the range of 2.
    np.testing.assert_allclose(mirror.actuator_state.applied, signals, atol=9e-5)
    with pytest.raises(DeformableMirrorError, match="37") as refused:
        mirror.set_signals([0.0] * 37)
    assert refused.value.error_code == ErrorCode.INVALID_LENGTH


def test_calibration_finds_every_actuator_in_its_place(calibrated: Calibrate.Result) -> None:
    assert calibrated.maps >= 2 * 19
    assert calibrated.maps_dropped == 0
    assert calibrated.poke_check_passed
    assert 0 < calibrated.in_sample_rms < calibrated.held_out_rms < 2e-9


@pytest.mark.parametrize("curvature", [-0.05, -0.02, 0.02, 0.05])
def test_open_loop_spheres(mirror: DeformableMirrorClient, calibrated: Calibrate.Result, curvature: float) -> None:
    prediction = mirror.focus(curvature, dry_run=True)
    mirror.move_focus(curvature, settle_time=0.5)
    measurement, image = mirror.measure_map(f"{curvature:+.3f}")
    error = surface_error(map_of(image), measurement.info, FocusTarget(curvature))
    assert abs(error.rms - prediction.predicted_rms) < 1.5e-9
    assert error.max_zernike < 632.8e-9 / 50
    assert not prediction.saturated


def test_the_unit_understood_every_frame(mirror: DeformableMirrorClient, calibrated: Calibrate.Result) -> None:
    values = bench_figures(mirror.node)
    assert int(values["frames"]) > 500
    assert int(values["violations"]) == 0
    assert int(values["malformed_frames"]) == 0


def few_actuators() -> CalibratedMirror:
    """A perfect calibration of the plate, with a figure of all 21 terms."""
    plate = Plate(PlateConfig(actuators=19, pitch=7e-3))
    points, radius, stroke = edge_clustered_points(500), 0.010, 4e-6
    sag = stroke * plate.influence_at(radius * points.x, radius * points.y)
    terms = basis(points.x, points.y)
    weighted = terms * points.weight[:, None]
    fit = np.linalg.solve(weighted.T @ terms, weighted.T)
    figure = 15e-9 * np.random.default_rng(SEED).standard_normal(21)
    model = InfluenceModel(radius, fit @ sag, figure, points, sag, terms @ figure, 1e-10, 1e-10)
    return CalibratedMirror(model, Limits(-1.0, 1.0, neighbour_pairs(plate.x, plate.y), 2.0))


@pytest.mark.parametrize("curvature", [-0.05, 0.0, 0.03])
def test_terms_that_no_actuator_moves_do_not_spoil_the_surface(curvature: float) -> None:
    """19 actuators cannot make 18 coefficients equal to anything; the surface is as good as least squares in sag."""
    mirror = few_actuators()
    model = mirror.model
    plan = mirror.plan(FocusTarget(curvature))
    points = edge_clustered_points(500)
    wanted = FocusTarget(curvature).sag(model.points.x, model.points.y, model.aperture_radius) - model.sag_offset
    root = np.sqrt(model.points.weight)
    matrix = root[:, None] * remove_piston_tilt(model.influence_sag.T, points).T
    right = root * remove_piston_tilt(wanted[None, :], points)[0]
    best = np.linalg.lstsq(matrix, right, rcond=1e-12)[0]
    limit = float(np.linalg.norm(matrix @ best - right))
    assert limit <= plan.rms < 1.2 * limit
    assert not plan.saturated.any()
