"""Whether a calibration belongs to a mirror, and sentences on its actuators."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from dm_common.mirror import APERTURE_TOLERANCE, Mirror, actuators_text, mismatch

MIRROR = Mirror("PDM", "S 7/é", np.array([0.0, 4.3e-3]), np.zeros(2), working_radius=11e-3)


def test_a_calibration_of_this_mirror_fits() -> None:
    assert mismatch(MIRROR, "S 7/é", 2, 11e-3) == ""
    assert mismatch(MIRROR, "S 7/é", 2, 11e-3 * 1.015) == ""
    assert mismatch(MIRROR, "S 7/é", 2, 11e-3 * (1 - 0.015)) == ""


def test_a_mismatch_names_both_sides() -> None:
    assert "'S 8', this is 'S 7/é'" in mismatch(MIRROR, "S 8", 2, 11e-3)
    assert "has 7 actuators, this mirror 2" in mismatch(MIRROR, "S 7/é", 7, 11e-3)
    assert "aperture radius 12.000 mm, this mirror's working aperture 11.000 mm" in mismatch(MIRROR, "S 7/é", 2, 12e-3)


@pytest.mark.parametrize("radius", [11e-3 * (1 + 1.01 * APERTURE_TOLERANCE), 0.0, np.nan, np.inf])
def test_another_aperture_or_none_is_a_mismatch(radius: float) -> None:
    assert mismatch(MIRROR, "S 7/é", 2, radius)


def test_what_is_no_mirror_is_named() -> None:
    lists = Mirror("PDM", "1", [0.0, 4.3e-3], [0.0, 0.0], working_radius=11e-3)  # type: ignore[arg-type]
    np.testing.assert_array_equal(lists.x, MIRROR.x)
    with pytest.raises(ValueError, match=r"reach 4\.3: must be m, within 1"):
        Mirror("PDM", "1", 1e3 * MIRROR.x, MIRROR.y, working_radius=11e-3)
    with pytest.raises(ValueError, match="serial = 1234: must be text"):
        Mirror("PDM", 1234, MIRROR.x, MIRROR.y, working_radius=11e-3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("numbers", "text", "sentence"),
    [
        ([5], "is/are dead", "actuator 5 is dead"),
        ([5, 7], "is/are dead", "actuators 5, 7 are dead"),
        (["7 (fixed at +0.30)"], "", "actuator 7 (fixed at +0.30)"),
        ((k + 1 for k in (0, 2)), "at a limit", "actuators 1, 3 at a limit"),
        ([], "is/are dead", ""),
    ],
)
def test_actuators_have_numbers_and_a_verb_that_agrees(numbers: Iterable[object], text: str, sentence: str) -> None:
    assert actuators_text(numbers, text) == sentence
