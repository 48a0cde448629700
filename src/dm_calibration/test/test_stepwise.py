"""Stepwise selection: what it finds, its statistics, its intervals, and what it refuses."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.regression.stepwise import FREEDOM_MIN, SelectionOptions, leave_one_out, stepwise
from dm_common.errors import ErrorCode, Refusal

NAMES = [f"x{k}" for k in range(58)]


@pytest.fixture
def sm() -> Any:
    """Not when the tests are collected, of whose time it took a tenth in every worker."""
    import statsmodels.api

    return statsmodels.api


def candidates(seed: int, n: int = 50, count: int = 58) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, count))


def test_without_statsmodels_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """For which rosdep has no key."""
    monkeypatch.setitem(sys.modules, "statsmodels.api", None)
    x = candidates(1)
    with pytest.raises(Refusal, match="apt-get install python3-statsmodels") as refused:
        stepwise(x, x[:, 3] + candidates(2)[:, 0], NAMES)
    assert refused.value.error_code == ErrorCode.NOT_SUPPORTED


@pytest.mark.slow
def test_finds_the_variables_that_matter_and_agrees_with_statsmodels(sm: Any) -> None:
    x = candidates(1)
    # Scales as apart as signals (1) and coefficients (1e-6 m).
    x[:, 40] *= 1e-6
    y = 50e-9 + 8e-9 * x[:, 3] - 5e-3 * x[:, 40] + 1e-9 * np.random.default_rng(2).standard_normal(50)
    fit = stepwise(x, y, NAMES, options=SelectionOptions(1e-4, 2e-4))
    assert set(fit.variables) == {"x3", "x40"}
    assert (fit.result.nobs, len(fit.variables)) == (50, 2)
    reference = sm.OLS(y, sm.add_constant(x[:, list(fit.columns)])).fit()
    assert fit.result.params == pytest.approx(reference.params, rel=1e-9)
    assert (fit.adjusted_r2, fit.f_statistic) == pytest.approx((reference.rsquared_adj, reference.fvalue))
    assert fit.result.mse_resid == pytest.approx(reference.mse_resid)
    assert fit.p_value == pytest.approx(reference.f_pvalue)
    frame = reference.get_prediction(np.column_stack((np.ones(5), x[:5, list(fit.columns)]))).summary_frame()
    mean, lower, upper = fit.predict(x[:5])
    assert mean == pytest.approx(frame["mean"].to_numpy())
    assert lower == pytest.approx(frame["obs_ci_lower"].to_numpy())
    assert upper == pytest.approx(frame["obs_ci_upper"].to_numpy())


@pytest.mark.slow
def test_a_variable_made_superfluous_by_later_ones_leaves_again() -> None:
    rng = np.random.default_rng(3)
    x = candidates(3, count=6)
    x[:, 2] = x[:, 0] + x[:, 1] + 0.3 * rng.standard_normal(50)
    y = x[:, 0] + 0.7 * x[:, 1] + 0.05 * rng.standard_normal(50)
    first = stepwise(x, y, NAMES[:6], options=SelectionOptions(1e-20, 1e-19))
    assert first.variables == ("x2",)  # the best single one
    fit = stepwise(x, y, NAMES[:6], options=SelectionOptions(1e-3, 2e-3))
    assert set(fit.variables) == {"x0", "x1"}


def test_weights_are_those_of_weighted_least_squares(sm: Any) -> None:
    rng = np.random.default_rng(4)
    x = candidates(4, n=400, count=3)
    weights = rng.uniform(0.05, 1.0, 400)
    y = 1.0 + 2.0 * x[:, 1] + 0.1 * rng.standard_normal(400) / np.sqrt(weights)
    fit = stepwise(x, y, NAMES[:3], weights, SelectionOptions(1e-6, 1e-5))
    assert fit.variables == ("x1",)
    reference = sm.WLS(y, sm.add_constant(x[:, 1]), weights=weights).fit()
    assert fit.result.params == pytest.approx(reference.params, rel=1e-9)
    mean, lower, upper = fit.predict(x, weights)
    inside = (lower <= y) & (y <= upper)
    light = weights < 0.2
    assert 0.90 < inside.mean() < 0.99
    assert inside[light].mean() > 0.87
    assert ((upper - mean)[light].mean()) > 2.0 * (upper - mean)[weights > 0.8].mean()


def test_intervals_hold_their_share_of_new_samples() -> None:
    rng = np.random.default_rng(5)
    x = candidates(5, n=60, count=4)
    fit = stepwise(x, x[:, 0] + 0.5 * rng.standard_normal(60), NAMES[:4], options=SelectionOptions(1e-6, 1e-5))
    new = rng.standard_normal((4000, 4))
    _, lower, upper = fit.predict(new)
    y = new[:, 0] + 0.5 * rng.standard_normal(4000)
    assert 0.90 < ((lower <= y) & (y <= upper)).mean() < 0.99


@pytest.mark.slow
def test_selection_makes_p_optimistic_and_leaving_out_tells() -> None:
    significant, worse = 0, 0
    for seed in range(10):
        x = candidates(100 + seed)
        y = np.random.default_rng(seed).standard_normal(50)  # has nothing to do with x
        fit = stepwise(x, y, NAMES)
        significant += fit.p_value < 0.05
        held_out = leave_one_out(x, y) - y
        worse += np.sqrt(np.mean(held_out**2)) > np.std(y)
    assert significant >= 8 and worse >= 8


def test_leaving_out_means_that_the_sample_has_no_say() -> None:
    x = candidates(6, count=8)
    y = x[:, 2] + 0.2 * np.random.default_rng(6).standard_normal(50)
    before = leave_one_out(x, y)
    y[7] += 100.0
    after = leave_one_out(x, y)
    assert after[7] == pytest.approx(before[7], rel=1e-12)
    assert np.abs(np.delete(after - before, 7)).max() > 1.0


def test_candidates_that_vary_in_one_sample_only_have_no_say_when_that_is_left_out() -> None:
    """Without that sample they are constant, but for rounding, which must not be taken for a variable."""
    for seed in range(10):
        random = np.random.default_rng(seed)
        x = np.tile(random.uniform(-1.0, 1.0, 58), (40, 1))
        x[:, :4] = random.standard_normal((40, 4))
        x[7] += 1.0
        y = 50.0 + 3.0 * x[:, 0] + random.standard_normal(40)
        weights = random.uniform(0.5, 2.0, 40)
        without = leave_one_out(x[:, :4], y, weights)
        assert leave_one_out(x, y, weights)[7] == pytest.approx(without[7])


def test_an_unexplained_response_gives_the_mean_alone() -> None:
    x = candidates(7, count=2)
    y = np.random.default_rng(8).standard_normal(50)
    fit = stepwise(x, y, NAMES[:2], options=SelectionOptions(1e-9, 1e-8))
    assert fit.variables == () and (fit.f_statistic, fit.p_value, fit.adjusted_r2) == (0.0, 1.0, 0.0)
    assert fit.predict(x)[0] == pytest.approx(np.full(50, y.mean()))


def test_an_exact_relation_is_found_and_ends_there() -> None:
    x = candidates(9)
    fit = stepwise(x, 3.0 + 2.0 * x[:, 5], NAMES)
    assert fit.variables[0] == "x5" and fit.predict(x)[0] == pytest.approx(3.0 + 2.0 * x[:, 5])


def test_freedom_is_left_however_mild_the_thresholds() -> None:
    x = candidates(10)
    y = np.random.default_rng(11).standard_normal(50)
    fit = stepwise(x, y, NAMES, options=SelectionOptions(0.98, 0.99))
    assert fit.result.nobs - len(fit.variables) - 1 == FREEDOM_MIN and len(fit.variables) > 10


def _duplicate(x: np.ndarray) -> None:
    x[:, 3] = 2.0 - 5.0 * x[:, 1]


def _sum(x: np.ndarray) -> None:
    x[:, 3] = x[:, 0] + x[:, 1] - x[:, 2]


def _constant(x: np.ndarray) -> None:
    x[:, 2] = 0.7


@pytest.mark.parametrize(
    ("spoil", "error", "words"),
    [
        (_duplicate, TooFewMapsError, "x1 and x3 are proportional"),
        (_sum, TooFewMapsError, "the other candidates determine x"),
        (_constant, TooFewMapsError, "x2 is the same for all samples"),
    ],
)
def test_candidates_refused(spoil: Any, error: type[Exception], words: str) -> None:
    x = candidates(12, count=5)
    y = x[:, 0].copy()
    spoil(x)
    with pytest.raises(error, match=words):
        stepwise(x, y, NAMES[:5])


def test_dependent_candidates_are_never_selected_together_when_samples_are_few() -> None:
    x = candidates(13, n=30, count=40)
    x[:, 3] = x[:, 0] + x[:, 1]
    y = x[:, 3] + 0.01 * np.random.default_rng(14).standard_normal(30)
    fit = stepwise(x, y, NAMES[:40])
    assert not {"x0", "x1", "x3"} <= set(fit.variables)
    assert np.isfinite(fit.result.bse).all()


def test_other_bad_input_is_refused_in_words() -> None:
    x, y = candidates(15, count=4), np.arange(50.0)
    with pytest.raises(TooFewMapsError, match=r"11 samples: .* need at least 12"):
        stepwise(x[:11], y[:11], NAMES[:4])
    with pytest.raises(TooFewMapsError, match="1 samples"):  # which differs from no other
        stepwise(x[:1], y[1:2], NAMES[:4])
    with pytest.raises(TooFewMapsError, match="11 samples"):
        leave_one_out(x[:12], y[:12])
    with pytest.raises(ValueError, match="the response is the same for all samples"):
        stepwise(x, np.full(50, 3e-8), NAMES[:4])
    with pytest.raises(ValueError, match=r"p_enter = 1\.5: must be above 0 and below 1"):
        SelectionOptions(p_enter=1.5)
    with pytest.raises(ValueError, match=r"p_remove = 0\.01: must be at least p_enter = 0\.05"):
        SelectionOptions(p_remove=0.01)
