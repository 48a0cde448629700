"""Lengths and counts in sentences."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from dm_common.figures import accuracy_text, counted, distinct_from, in_nanometres, in_wavelengths
from dm_common.optics.conic import range_text


@pytest.mark.parametrize(
    ("length", "nanometres", "wavelengths"),
    [
        (1.31e-9, "1.3 nm", "λ/483"),
        (97.2e-9, "97 nm", "λ/7"),
        (437e-9, "437 nm", ""),  # no λ/1
        (632.8e-9, "633 nm", ""),
        (2e-6, "2000 nm", ""),
        (0.0, "0 nm", ""),
    ],
)
def test_a_length_in_nanometres_and_by_the_wavelength(length: float, nanometres: str, wavelengths: str) -> None:
    assert (in_nanometres(length), in_wavelengths(length, 632.8e-9)) == (nanometres, wavelengths)


@pytest.mark.parametrize(
    ("length", "other", "text"),
    [
        (3.11e-9, 2e-9, "3.1 nm"),
        (2.04e-9, 2e-9, "2.04 nm"),
        (153.2e-9, 153.4e-9, "153.2 nm"),
        (2e-9, 2e-9, "2 nm"),
        (2.04e-9, 0.0, "2 nm"),
    ],
)
def test_a_length_is_told_from_the_one_beside_it(length: float, other: float, text: str) -> None:
    assert distinct_from(length, other) == text


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (-0.05128, 0.03776, "-0.0512 to +0.0377 1/m"),
        (-0.05, 0.0377, "-0.0500 to +0.0377 1/m"),  # on the mark is inside
        (-0.00004, 0.03776, "+0.0000 to +0.0377 1/m"),
        (0.03772, 0.03776, "+0.0377 to +0.0378 1/m"),  # nothing lies between two marks
        (float("nan"), float("nan"), "+nan to +nan 1/m"),
    ],
)
def test_a_range_is_rounded_inwards(low: float, high: float, text: str) -> None:
    assert range_text(low, high, "1/m") == text


@pytest.mark.parametrize(
    ("repeatable", "instrument", "scale", "text"),
    [
        (0.0, 1e-9, 1e-3, "repeatability not known"),
        (float("nan"), 1e-9, 1e-3, "repeatability not known"),
        (
            2e-9,
            0.0,
            1e-3,
            "repeatable to 2 nm (λ/316); absolute not known (instrument_error of the interferometer not given)",
        ),
        # A thousandth of the lateral scale is 3 nm at 0.05 1/m over 11 mm.
        (
            1e-9,
            1e-10,
            1e-3,
            "repeatable to 1 nm (λ/633), absolute to 3.2 nm (λ/199), limited by the lateral scale",
        ),
        (
            1e-9,
            5e-9,
            1e-4,
            "repeatable to 1 nm (λ/633), absolute to 5.1 nm (λ/124), limited by the instrument's own error",
        ),
    ],
)
def test_a_bound_is_put_twice(repeatable: float, instrument: float, scale: float, text: str) -> None:
    instrument_of = {"instrument_error": instrument, "scale_error": scale}
    calibration = SimpleNamespace(wavelength=632.8e-9, aperture_radius=11e-3, **instrument_of)
    assert accuracy_text(repeatable, calibration, -0.05) == text


def test_a_count_agrees_with_its_noun() -> None:
    assert [counted(count, "map") for count in (0, 1, 2)] == ["no map", "1 map", "2 maps"]
    assert [counted(count, "map is", "maps are") for count in (0, 1, 2)] == ["no map is", "1 map is", "2 maps are"]
