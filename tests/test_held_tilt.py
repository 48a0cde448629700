"""The picture of a camera stands still while the focus changes: what noisy maps and geometry say of tilt is enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_common.optics.zernike import basis
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.target import FocusTarget
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model

pytestmark = pytest.mark.slow

#: Shift of the picture of the demonstration's camera: twice the angle, 0.2 m, 3.45 um.
FOCAL_LENGTH_PX = 0.2 / 3.45e-6


def test_the_picture_stands_still_while_the_focus_changes() -> None:
    """A plate with unequal actuators and figure, calibrated by an interferometer whose own tilt is 300 nm a map."""
    bench = SimulatedBench(SimulationConfig(seed=4, law="preisach", pixels=118))
    calibration = bench.calibrate()
    model = influence_model(calibration.fit, calibration.aperture_radius)
    model = replace(model, actuator_x=calibration.actuator_x, actuator_y=calibration.actuator_y)
    rows, columns = np.nonzero(np.isfinite(bench.true_map()))
    aperture = bench.aperture
    x, y = (columns - aperture.centre_x_px) / aperture.radius_px, (aperture.centre_y_px - rows) / aperture.radius_px
    tilt = (np.linalg.pinv(basis(x, y)) @ bench.true_influence()[0])[1:3] * bench.true_stroke
    targets = [FocusTarget(float(curvature)) for curvature in np.linspace(-0.05, 0.05, 7)]

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
