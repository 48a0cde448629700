"""The kernels of the full-map fit against plain products over all pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import legendre

from dm_calibration.optics.map_moments import MaskedMoments, mask_moments


def bases(shape: tuple[int, int], degree: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = (legendre.legvander(np.linspace(-1, 1, size), degree) for size in shape)
    return rows, columns


@settings(max_examples=30, deadline=None)
@given(
    height=st.integers(1, 150),
    width=st.integers(1, 90),
    missing=st.sampled_from([0.0, 0.01, 0.3, 1.0]),
    seed=st.integers(0, 10**6),
)
def test_moments_of_a_mask_equal_the_plain_product(height: int, width: int, missing: float, seed: int) -> None:
    mask = np.random.default_rng(seed).random((height, width)) >= missing
    rows, columns = bases(mask.shape, 10)
    np.testing.assert_allclose(mask_moments(mask, rows, columns), rows.T @ mask @ columns, atol=1e-9)


@pytest.mark.parametrize("shape", [(1, 7), (7, 1), (300, 944), pytest.param((130, 60_000), marks=pytest.mark.slow)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_moments_and_energy_of_a_map_equal_the_plain_product(shape: tuple[int, int], order: str) -> None:
    """One row, one column, several blocks of rows, and rows longer than a block; maps turned by 90 degrees are F."""
    rng = np.random.default_rng(0)
    mask = rng.random(shape) < 0.9
    mask[:, : shape[1] // 5] = False
    sag = np.asarray(np.where(mask, rng.normal(size=shape), np.nan), order=order)  # type: ignore[call-overload]
    rows, columns = bases(shape, 5)
    found, energy = MaskedMoments(mask, rows, columns).of(sag)
    filled = np.where(mask, sag, 0.0)
    scale = np.abs(rows).T @ np.abs(filled) @ np.abs(columns)
    assert (np.abs(found - rows.T @ filled @ columns) <= 1e-13 * scale + 1e-300).all()
    assert energy == pytest.approx((filled**2).sum(), rel=1e-12)
