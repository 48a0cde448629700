"""The limitations of an influence function, in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dm_calibration.influence.maps import EXCITATION, MapSet
from dm_calibration.influence.quality import GRADE_DEAD, GRADE_NOT_EXCITED, GRADE_WEAK
from dm_calibration.influence.regression import Design


def limitations(good: MapSet, design: Design, grades: NDArray[np.uint8], tilt_known: bool, untested: int) -> list[str]:
    """What a user of an influence function fitted to the maps `good` must know, in sentences.

    Args:
        design: of these maps.
        grades: (N,) GRADE_*.
        tilt_known: whether the maps show the mirror's tilt.
        untested: number of maps that the cross-validation could not judge.
    """
    if EXCITATION in good.kind:
        sentences = ["The influence function acts on effective signals; hysteresis and creep are in the memory law."]
    else:
        sentences = ["The model is linear and without memory: hysteresis and creep stay in its error."]
    if not tilt_known:
        sentences.append(
            "The maps do not show the mirror's tilt (the interferometer's own is larger); "
            "the condition number leaves tilt out."
        )
    if design.drift == 1:
        sentences.append("The figure is taken as constant over the run: too few reference frames to follow its drift.")
    for value, words in (
        (GRADE_WEAK, "respond weakly or uncertainly"),
        (GRADE_DEAD, "show no response above the noise"),
        (GRADE_NOT_EXCITED, "were never moved and count as without effect"),
    ):
        numbers = np.flatnonzero(grades == value) + 1
        if numbers.size:
            sentences.append(f"Actuators {', '.join(map(str, numbers))} {words}.")
    if untested:
        sentences.append(
            f"{untested} maps move an actuator as no other map does; predicting them from the others would be "
            "extrapolation, so they do not count in the held-out error."
        )
    blind = np.isnan(good.sag).all(axis=0).sum()
    if blind:
        sentences.append(f"{blind} of the {good.points.x.size} sampling points have no data in any map.")
    return sentences
