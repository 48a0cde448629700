"""Lengths in sentences."""

from __future__ import annotations

import pytest

from dm_common.figures import in_nanometres, in_wavelengths


@pytest.mark.parametrize(
    ("length", "nanometres", "wavelengths"),
    [
        (1.31e-9, "1.3 nm", "λ/483"),
        (97.2e-9, "97 nm", "λ/7"),
        (632.8e-9, "633 nm", "λ/1"),
        (2e-6, "2000 nm", "3.2 λ"),
        (0.0, "0 nm", "0"),
    ],
)
def test_a_length_in_nanometres_and_by_the_wavelength(length: float, nanometres: str, wavelengths: str) -> None:
    assert (in_nanometres(length), in_wavelengths(length, 632.8e-9)) == (nanometres, wavelengths)
