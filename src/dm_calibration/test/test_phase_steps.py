"""Regions of a map that stand whole fringes off are found and brought back; others are refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.map_files import SurfaceMap
from dm_calibration.optics.aperture import MapRejectedError
from dm_calibration.optics.phase_steps import mend_phase_steps

WAVELENGTH = 632.8e-9
FRINGE = WAVELENGTH / 2
Y, X = np.mgrid[1.0:-1.0:200j, -1.0:1.0:200j]


@pytest.fixture
def sag() -> NDArray[np.float64]:
    """A tilted bowl with noise and holes."""
    random = np.random.default_rng(4)
    sag = 2e-6 * (X**2 + Y**2) + 1e-6 * X + 2e-9 * random.standard_normal(X.shape)
    sag[X**2 + Y**2 > 1.0] = np.nan
    sag.flat[random.integers(0, sag.size, 300)] = np.nan
    return sag


@pytest.mark.parametrize(
    ("where", "regions"),
    [
        (X > 0.4, 1),
        (X**2 + (Y - 0.5) ** 2 < 0.04, 1),
        ((X > 0.4) | (X < -0.5), 2),
        ((np.abs(X) < 0.6) & (np.abs(Y) < 0.01), 1),
    ],
)
@pytest.mark.parametrize("fringes", [1, -3])
def test_a_region_that_is_whole_fringes_off_is_brought_back(
    sag: NDArray[np.float64], where: NDArray[np.bool_], regions: int, fringes: int
) -> None:
    stepped = sag + fringes * FRINGE * where
    mended, found = mend_phase_steps(stepped, FRINGE)
    assert found == regions
    np.testing.assert_allclose(mended, sag, atol=1e-12)


def test_a_gap_hides_no_step(sag: NDArray[np.float64]) -> None:
    sag[np.abs(X) < 0.011] = np.nan
    assert mend_phase_steps(sag, FRINGE)[1] == 0
    mended, found = mend_phase_steps(sag + FRINGE * (X > 0.0), FRINGE)
    assert found == 1
    np.testing.assert_allclose(mended - sag, np.nanmedian(mended - sag) * np.ones_like(sag) + 0.0 * sag, atol=1e-12)


def test_what_was_counted_right_stays_as_it_is(sag: NDArray[np.float64]) -> None:
    sag[50, 60] += 0.4e-6  # a speck
    assert mend_phase_steps(sag, FRINGE) == (pytest.approx(sag, nan_ok=True, abs=0.0), 0)


def test_another_step_is_refused_by_its_place(sag: NDArray[np.float64]) -> None:
    with pytest.raises(MapRejectedError, match=r"about column 1[67]\d, row (99|100) is \+1.50 fringes off"):
        mend_phase_steps(sag + 1.5 * FRINGE * (X > 0.4), FRINGE)


def test_maps_are_mended_as_they_are_read(sag: NDArray[np.float64]) -> None:
    settings = IngestSettings(pitch=1e-4, valid_fraction_min=0.5)
    right = Ingest().measure(SurfaceMap(sag, WAVELENGTH, None, "array"), settings)[1]
    stepped = SurfaceMap(sag + FRINGE * (X > 0.4), WAVELENGTH, None, "array")
    surface, measured = Ingest().measure(stepped, settings)
    assert surface.phase_steps == 1
    np.testing.assert_allclose(measured.coefficients, right.coefficients, atol=1e-12)
    np.testing.assert_allclose(measured.sag, right.sag, atol=1e-12)
    with pytest.raises(MapRejectedError, match="fringes off"):
        Ingest().measure(SurfaceMap(sag + 0.7 * WAVELENGTH * (X > 0.4), WAVELENGTH, None, "array"), settings)
