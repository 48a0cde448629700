"""Memory laws and synthetic runs that several test modules share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.identify import Run
from dm_calibration.hysteresis.responses import Responses
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.mirror import Mirror
from dm_simulation.mirror.piezo import PiezoActuators, PiezoConfig

Floats = NDArray[np.float64]

RADIUS = np.array([0.0, 0.1, 0.3, 0.6])


def plays(creep_rate: float = 0.0) -> HysteresisModel:
    """Prandtl-Ishlinskii."""
    weight = np.array([[0.8], [0.1], [0.1], [0.05]])
    return HysteresisModel(RADIUS, weight, np.zeros(0), 0.0, creep_rate, CREEP_TIMES)


def rich(creep_rate: float = 0.01) -> HysteresisModel:
    """Preisach of second order and a Duhem operator, with creep."""
    weight = np.array([[0.9, 0.05], [0.1, 0.02], [0.08, 0.01], [0.05, 0.01]])
    return HysteresisModel(RADIUS, weight, np.array([1.6, 0.3]), -0.1, creep_rate, CREEP_TIMES)


def hexagon() -> Mirror:
    """Seven actuators."""
    angle = np.arange(6) * np.pi / 3
    x, y = np.concatenate(([0.0], np.cos(angle))), np.concatenate(([0.0], np.sin(angle)))
    ring = np.column_stack((np.arange(1, 7), np.roll(np.arange(1, 7), -1)))
    neighbours = np.vstack((np.column_stack((np.zeros(6, dtype=int), np.arange(1, 7))), ring))
    return Mirror("hexagon", "1", x, y, 1.2, neighbours=neighbours)


def twin_run(
    law: str, maps: int = 150, noise: float = 2e-10, creep: float = 0.01, seed: int = 3
) -> tuple[Run, NDArray[np.bool_]]:
    """A run of the excitation on the twin's actuators, seven of them, seen through a random matrix, and its checks."""
    mirror = hexagon()
    rng = np.random.default_rng(seed)
    piezo = PiezoActuators(PiezoConfig(law=law, creep=creep), rng, np.zeros(mirror.actuators))
    commands = excitation(mirror, maps)
    mixing = rng.standard_normal((mirror.actuators, 12)) / 4.0
    time = np.cumsum(1.0 + commands.dwell)
    values = []
    for signals, seen in zip(commands.signals, time, strict=True):
        piezo.apply(signals, piezo._time)
        piezo.advance(float(seen))
        values.append(piezo.displacement @ mixing)
    measured = np.array(values) + noise * rng.standard_normal((maps, mixing.shape[1]))
    responses = Responses(measured, mixing.shape[1], np.ones(maps, dtype=bool))
    return Run(commands.signals, time, responses, 0.0), commands.check
