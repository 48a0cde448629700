"""The readings of the paper's regression: split, held-out figures, Tables 2 and 3."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dm_calibration.influence.fit import fit_influence
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.regression.stepwise import SelectionOptions
from dm_calibration.regression.surface_error import MODEL
from dm_common.errors import UnknownNameError
from hysteretic_mirror import calibrated, calibrated_by_pokes
from studies.paper.readings import Reading, regress_surface_errors
from studies.paper.reported import TEST_SURFACES as TEST_SET


@pytest.mark.slow
@pytest.mark.parametrize("method", ["AZreg", "AZWreg"])
def test_following_the_history_predicts_the_test_set(method: str) -> None:
    maps, fit = calibrated(method)
    results = {reading: regress_surface_errors(maps, fit, reading) for reading in Reading}
    history = results[Reading.HISTORY]
    assert MODEL in history.fit.variables
    assert [row.surface for row in history.table3] == list(TEST_SET)
    assert max(row.relative_error for row in history.table3) <= 0.07
    for reading in (Reading.LINEAR, Reading.COMMAND):
        assert history.table2.test_rms < 0.5 * results[reading].table2.test_rms
        assert history.table2.leave_one_out_rms < 0.5 * results[reading].table2.leave_one_out_rms
    for reading, result in results.items():
        table2 = result.table2
        assert (table2.n, table2.model, table2.reading) == (50, method, reading.value)
        if table2.k:
            explained, freedom = table2.k * table2.f_statistic, 49 - table2.k  # R^2 = kF / (kF + n - k - 1)
            assert table2.adjusted_r2 == pytest.approx(1.0 - 49.0 / (explained + freedom))
            assert table2.p_value == pytest.approx(stats.f.sf(table2.f_statistic, table2.k, freedom))
        for row in result.table3:
            assert row.error == pytest.approx(row.predicted - row.actual)
            assert row.relative_error == pytest.approx(abs(row.error) / row.actual)
            assert row.lower < row.predicted < row.upper
        squares = [row.error**2 for row in result.table3]
        assert table2.test_rms == pytest.approx(np.sqrt(np.mean(squares)))


@pytest.mark.slow
@pytest.mark.parametrize("reading", list(Reading))
def test_the_test_maps_have_no_say_in_their_prediction(reading: Reading) -> None:
    maps, fit = calibrated()
    before = regress_surface_errors(maps, fit, reading)
    sag, coefficients = maps.sag.copy(), maps.coefficients.copy()
    rows = np.isin(maps.label, TEST_SET)
    sag[rows] *= 3.0
    coefficients[rows] *= 3.0
    after = regress_surface_errors(replace(maps, sag=sag, coefficients=coefficients), fit, reading)
    assert after.fit.variables == before.fit.variables
    assert after.fit.result.params == pytest.approx(before.fit.result.params, rel=1e-9)
    assert after.table3[0].actual != pytest.approx(before.table3[0].actual)
    if reading in (Reading.COMMAND, Reading.HISTORY):  # nothing measured on the surface enters
        assert [row.predicted for row in after.table3] == pytest.approx([row.predicted for row in before.table3])


@pytest.mark.slow
def test_points_without_data_do_not_disturb() -> None:
    maps, fit = calibrated()
    sag = maps.sag.copy()
    holes = np.random.default_rng(4).random(sag.shape) < 0.002
    assert holes[np.isin(maps.label, TEST_SET)].any()
    sag[holes] = np.nan
    whole = regress_surface_errors(maps, fit)
    holed = regress_surface_errors(replace(maps, sag=sag), fit)
    for one, other in zip(whole.table3, holed.table3, strict=True):
        assert other.predicted == pytest.approx(one.predicted, rel=0.03)


@pytest.mark.slow
def test_a_map_that_was_dropped_leaves_the_regression() -> None:
    maps, _ = calibrated()
    without = fit_influence(maps, exclude=["p20"])
    assert regress_surface_errors(maps, without, Reading.COMMAND).table2.n == 49


def test_thresholds_can_be_given() -> None:
    maps, fit = calibrated()
    none = regress_surface_errors(maps, fit, Reading.LINEAR, SelectionOptions(1e-300, 1e-200))
    assert none.fit.variables == ()


def test_bad_input_is_refused_in_words() -> None:
    maps, fit = calibrated()
    with pytest.raises(UnknownNameError, match="test surface 'p60' is unknown"):
        regress_surface_errors(maps, fit, test_set=("p60",))
    with pytest.raises(UnknownNameError, match="test surface 'pz01'"):
        regress_surface_errors(maps, fit, test_set=("pz01",))
    with pytest.raises(TooFewMapsError, match="calibrate with the plan full"):
        regress_surface_errors(*calibrated_by_pokes())
    few = np.array([not (label.startswith("p") and label[1:].isdigit() and int(label[1:]) > 9) for label in maps.label])
    kept = maps.select(few)
    with pytest.raises(TooFewMapsError, match=r"7 samples: .* measure more surfaces"):
        regress_surface_errors(kept, fit_influence(kept), Reading.LINEAR)
