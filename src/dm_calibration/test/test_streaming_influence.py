"""The influence function map by map against one regression over all maps."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.influence.streaming import BUFFERED_MAPS, InfluenceAccumulator

SHAPE = (20, 30)


def a_run(maps: int, unknowns: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Design (maps, unknowns) and maps (maps, 20, 30) that no influence function explains in full."""
    rng = np.random.default_rng(3)
    return rng.uniform(-1, 1, (maps, unknowns)), rng.normal(size=(maps, *SHAPE)) * 1e-6


def streamed(design: np.ndarray, maps: np.ndarray) -> np.ndarray:
    accumulator = InfluenceAccumulator(design, SHAPE)
    for sag in maps:
        accumulator.add(sag)
    return accumulator.result()


@pytest.mark.parametrize("count", [5, BUFFERED_MAPS, 2 * BUFFERED_MAPS + 3])
def test_equals_least_squares_over_all_maps(count: int) -> None:
    design, maps = a_run(count)
    expected = np.linalg.lstsq(design, maps.reshape(count, -1), rcond=None)[0]
    np.testing.assert_allclose(streamed(design, maps).reshape(5, -1), expected, rtol=1e-9, atol=1e-17)


def test_a_pixel_without_data_in_one_map_is_unknown_and_no_other() -> None:
    design, maps = a_run(25)
    whole = streamed(design, maps)
    maps[7, 3, 4] = np.nan
    found = streamed(design, maps)
    assert np.isnan(found[:, 3, 4]).all()
    whole[:, 3, 4] = np.nan
    np.testing.assert_array_equal(found, whole)


def test_commands_of_very_unequal_size_keep_their_digits() -> None:
    design, _maps = a_run(30)
    design[:, 0] *= 1e-6  # squared, as in normal equations, it would be lost in rounding
    truth = np.random.default_rng(4).normal(size=(5, *SHAPE))
    np.testing.assert_allclose(streamed(design, np.tensordot(design, truth, 1)), truth, rtol=0, atol=1e-8)


def test_maps_that_do_not_fit_the_run_are_refused() -> None:
    design, maps = a_run(6)
    accumulator = InfluenceAccumulator(design, SHAPE)
    with pytest.raises(ValueError, match=r"map 1 has the shape \(30, 20\): must be \(20, 30\)"):
        accumulator.add(maps[0].T)
    for sag in maps[:5]:
        accumulator.add(sag)
    with pytest.raises(ValueError, match="5 maps were added: the design has 6 rows"):
        accumulator.result()
    accumulator.add(maps[5])
    with pytest.raises(ValueError, match="map 7: the design has only 6 rows"):
        accumulator.add(maps[5])


def test_designs_that_determine_nothing_are_refused() -> None:
    design, _maps = a_run(8)
    with pytest.raises(ValueError, match="at least as many maps as unknowns"):
        InfluenceAccumulator(design[:4], SHAPE)
    design[:, 1] = design[:, 2]
    with pytest.raises(ValueError, match="do not tell the actuators apart"):
        InfluenceAccumulator(design, SHAPE)
