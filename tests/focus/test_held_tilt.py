"""The picture of a camera stands still while the focus changes: what noisy maps and geometry say of tilt is enough."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from dm_autofocus.boresight import STEP, find_boresight
from dm_autofocus.optics import depth_of_focus
from dm_calibration.calibration_messages import calibration_message
from dm_common.messages import mirror_info_of
from dm_common.optics.zernike import TERMS, basis
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.planning.target import FocusTarget
from dm_simulation.camera import CameraConfig, SceneCamera
from dm_tools import boresight
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model

pytestmark = pytest.mark.slow

#: Shift of the picture of the demonstration's camera: twice the angle, 0.2 m, 3.45 um.
FOCAL_LENGTH_PX = 0.2 / 3.45e-6
RANGE = 0.05


class Calibrated(NamedTuple):
    """A plate with unequal actuators and figure, calibrated by an interferometer whose own tilt is 300 nm a map."""

    bench: SimulatedBench
    model: InfluenceModel
    message: Any


@pytest.fixture(scope="module")
def calibrated() -> Calibrated:
    bench = SimulatedBench(SimulationConfig(seed=4, law="preisach", pixels=118))
    calibration = bench.calibrate()
    model = influence_model(calibration.fit, calibration.aperture_radius)
    model = replace(model, actuator_x=calibration.actuator_x, actuator_y=calibration.actuator_y)
    return Calibrated(bench, model, calibration_message(calibration, None, "mirror", 10e-9))


def test_the_picture_stands_still_while_the_focus_changes(calibrated: Calibrated) -> None:
    bench, model, _message = calibrated
    rows, columns = np.nonzero(np.isfinite(bench.true_map()))
    aperture = bench.aperture
    x, y = (columns - aperture.centre_x_px) / aperture.radius_px, (aperture.centre_y_px - rows) / aperture.radius_px
    tilt = (np.linalg.pinv(basis(x, y)) @ bench.true_influence()[0])[1:3] * bench.true_stroke
    targets = [FocusTarget(float(curvature)) for curvature in np.linspace(-RANGE, RANGE, 7)]

    def moved(mirror: CalibratedMirror) -> float:
        """Largest shift, px, over the range, along either axis."""
        angles = np.array([2 / model.aperture_radius * tilt @ mirror.command(target)[0] for target in targets])
        return float(FOCAL_LENGTH_PX * np.ptp(angles, axis=0).max())

    held, free = CalibratedMirror(model, bench.limits), CalibratedMirror(model, bench.limits, hold_tilt=False)
    assert moved(held) <= 0.5
    assert moved(free) > 2
    for target in targets:
        with_tilt, without = held.plan(target), free.plan(target)
        assert with_tilt.max_zernike < 1e-10
        assert with_tilt.rms < 1.01 * without.rms + 0.1e-9, "the shape does not suffer"
    narrow = [mirror.reachable_range(FocusTarget(0.0), 20e-9) for mirror in (held, free)]
    np.testing.assert_allclose(narrow[0], narrow[1], rtol=0.01)
    unknown = replace(model, actuator_x=None)
    assert CalibratedMirror(unknown, bench.limits).tilt is None, "without the actuators' places it is free"


class Eccentric:
    """A camera that looks at the mirror beside its middle, through a smaller pupil."""

    DIAMETER, AXIS = 20e-3, np.array([0.5e-3, -0.3e-3])

    def __init__(self, calibrated: Calibrated, axis: tuple[float, ...] = (0.0, 0.0), hold_tilt: bool = True) -> None:
        self._bench, model, _message = calibrated
        self.mirror = CalibratedMirror(model, self._bench.limits, hold_tilt, axis)
        self._radius = model.aperture_radius
        seeds = (np.random.default_rng(seed) for seed in (3, 4))
        self._camera = SceneCamera(CameraConfig(distances=(10.0,)), self.DIAMETER, *seeds)
        self._nodes = np.cos(np.pi * (np.arange(60) + 0.5) / 60)

    def surface(self, curvature: float, tilt: NDArray) -> NDArray:
        """The true surface over the pupil."""
        zernike = np.zeros(len(TERMS))
        zernike[1:3] = tilt
        signals = self.mirror.command(FocusTarget(curvature, 0.0, tuple(zernike)))[0]
        whole = self._bench._interferometer.surface(self._bench.true_stroke * signals)
        at = self._nodes * self.DIAMETER / 2 / self._radius
        order = len(whole) - 1
        x, y = (chebyshev.chebvander(at + off / self._radius, order) for off in self.AXIS)
        back = np.linalg.pinv(chebyshev.chebvander(self._nodes, order))
        return np.asarray(back @ (y @ whole @ x.T) @ back.T)

    def see(self, curvature: float, tilt: NDArray) -> NDArray:
        return self._camera.expose(self.surface(curvature, tilt))

    def moved(self) -> float:
        """Shift [px] over the range, along either axis: twice the mean slope."""
        low, high = (self.surface(curvature, np.zeros(2)) for curvature in (-RANGE, RANGE))
        grid = np.linspace(-1, 1, 81)
        values = chebyshev.chebval2d(*np.meshgrid(grid, grid, indexing="ij"), high - low)
        inside = np.add.outer(grid**2, grid**2) <= 1
        slopes = [axis[inside].mean() for axis in np.gradient(values, grid, grid)]
        return float(2 / (self.DIAMETER / 2) * FOCAL_LENGTH_PX * np.abs(slopes).max())


def test_a_camera_that_looks_beside_the_middle_finds_its_axis(calibrated: Calibrated) -> None:
    before = Eccentric(calibrated)
    step = STEP * depth_of_focus(before.mirror.model.aperture_radius)
    found = find_boresight(before.see, 0.0, step)
    axis = found.offset(before.mirror.model.aperture_radius)
    np.testing.assert_allclose(axis, Eccentric.AXIS, atol=0.1e-3)  # as the calibration's tilts count
    after = Eccentric(calibrated, tuple(axis))
    assert before.moved() > 5
    assert after.moved() <= 0.5
    again = find_boresight(after.see, 0.0, step)
    assert np.abs(2 * RANGE * again.drift).max() <= 0.5, "by the camera's own images"
    free = Eccentric(calibrated, hold_tilt=False)
    with pytest.raises(ValueError, match="does the calibration not know where the actuators are"):
        find_boresight(free.see, 0.0, step)


def test_what_a_picture_that_stands_still_costs(calibrated: Calibrated, monkeypatch: pytest.MonkeyPatch) -> None:
    """`dm calibrate --boresight` says it: hardly any range, and no residual."""
    bench, model, message = calibrated
    client = SimpleNamespace(
        capabilities=SimpleNamespace(curvature_min=-RANGE, curvature_max=RANGE),
        mirror_info=mirror_info_of(bench.mirror),
        latest=lambda _topic: message,
    )
    monkeypatch.setattr(boresight, "get_parameter", lambda *_of: 20e-9)
    cost = boresight.price(client, Eccentric.AXIS)
    for name, hold in (("held", True), ("free", False)):
        mirror = CalibratedMirror(model, bench.limits, hold, tuple(Eccentric.AXIS))
        reach = mirror.reachable_range(FocusTarget(0.0), 20e-9)
        assert (cost[name]["curvature_min"], cost[name]["curvature_max"]) == pytest.approx(reach, rel=1e-6)
    spans = {name: figures["curvature_max"] - figures["curvature_min"] for name, figures in cost.items()}
    assert 0.98 < spans["held"] / spans["free"] <= 1
    residuals = {name: figures["residual_rms_nm"] for name, figures in cost.items()}
    assert residuals["free"] <= residuals["held"] < residuals["free"] + 0.5
