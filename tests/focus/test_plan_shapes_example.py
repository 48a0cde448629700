"""The example that plans shapes without ROS, on a mirror whose law is known."""

from __future__ import annotations

import runpy
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_calibration import calibrate, calibrator
from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.features import follow
from dm_calibration.hysteresis.hysteresis_fit import fit_hysteresis
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from linear_mirror import LinearMirror, make_mirror

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/plan_shapes.py"


@pytest.mark.slow
def test_the_example_focuses_a_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mirror = make_mirror(rings=2)
    plant = LinearMirror(mirror.x, mirror.y)
    law = HysteresisModel(
        np.array([0.0, 0.225, 0.475]), np.array([[0.7], [0.2], [0.1]]), np.zeros(0), 0.0, 0.01, CREEP_TIMES
    )
    moves = excitation(mirror, 80)
    began = time.time() - float((1.0 + moves.dwell).sum())
    times = began + np.cumsum(1.0 + moves.dwell)
    demagnetised = law.demagnetised(mirror.actuators, began, 0.0)
    effective, _ = follow(law, demagnetised, moves.signals, times, np.concatenate(([began], times[:-1])))
    maps = [plant.measurement(plant.sag(row), int(1e9 * at)) for row, at in zip(effective, times, strict=True)]
    monkeypatch.setattr(calibrator, "fit_hysteresis", partial(fit_hysteresis, candidates=COMMON))
    made = calibrate(maps, moves.signals, times, mirror=mirror, hysteresis=True)
    file = CalibrationStore(tmp_path).save(made)

    monkeypatch.setattr(sys, "argv", ["plan_shapes.py", str(file)])
    used: dict[str, Any] = runpy.run_path(str(EXAMPLE))
    assert capsys.readouterr().out.count("by its maps") == 5
    # The mirror itself, from the signals that were sent: after all moves it has the last shape.
    state = law.degaussed(demagnetised, used["sent"][0][0], 0.0)
    for at, signals in used["sent"]:
        state = law.move(state, signals, at)
    shape = plant.figure_coefficients + plant.fit_terms(plant.influence @ law.effective(state))
    left = shape - used["move"].target.coefficients(mirror.working_radius)
    assert np.abs(left[3:]).max() < used["move"].plan.max_zernike_upper
    assert used["move"].target.curvature == pytest.approx(0.8 * used["high"]) and used["high"] > 0.01
