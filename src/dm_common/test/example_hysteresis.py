"""Hysteresis models that several test modules share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel

RADIUS = np.array([0.0, 0.1, 0.3, 0.6])


def plays(creep_rate: float = 0.0) -> HysteresisModel:
    """Prandtl-Ishlinskii."""
    weight = np.array([[0.8], [0.1], [0.1], [0.05]])
    return HysteresisModel(RADIUS, weight, np.zeros(0), 0.0, creep_rate, CREEP_TIMES)


def rich(creep_rate: float = 0.01) -> HysteresisModel:
    """Preisach of second order and a Duhem operator, with creep."""
    weight = np.array([[0.9, 0.05], [0.1, 0.02], [0.08, 0.01], [0.05, 0.01]])
    return HysteresisModel(RADIUS, weight, np.array([1.6, 0.3]), -0.1, creep_rate, CREEP_TIMES)


def fading() -> HysteresisModel:
    """One of which a part fades at two rates, and follows the signal and its square."""
    drive = np.array([[-0.05, 0.02, 0.01], [0.03, 0.01, -0.04]])
    return replace(rich(), fading_rate=np.array([1.0, 6.0]), fading_weight=drive)


def lagging() -> HysteresisModel:
    """One whose loops are wider for fast moves, and whose creep changes over the range."""
    return replace(rich(), lag_spectrum=np.full(7, 2.5), creep_slope=0.15)
