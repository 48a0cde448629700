"""Lengths in sentences."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from dm_common.figures import in_nanometres, in_wavelengths, two_fold


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
    ("repeatable", "instrument", "scale", "text"),
    [
        (0.0, 1e-9, 1e-3, "repeatable to what is not known"),
        (float("nan"), 1e-9, 1e-3, "repeatable to what is not known"),
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
    assert two_fold(repeatable, calibration, -0.05) == text
