"""Statements of [1] that can be checked without its data: Table 2 is consistent, Eq. (7) is Eq. (6)."""

from __future__ import annotations

import numpy as np
import pytest

from studies.paper.f_statistic import adjusted_r2_of_f, p_of_f
from studies.paper.weights_cancel import weights_cancel_max_abs


@pytest.mark.parametrize(
    ("n", "k", "f", "adjusted_r2", "p"),
    [(50, 6, 3.055, 0.2010, 1.404e-2), (49, 17, 10.123, 0.7637, 2.4776e-8)],
)
def test_table_2_of_the_paper_is_consistent(n: int, k: int, f: float, adjusted_r2: float, p: float) -> None:
    assert adjusted_r2_of_f(f, n, k) == pytest.approx(adjusted_r2, abs=5e-5)
    assert p_of_f(f, n, k) == pytest.approx(p, rel=1e-3)


def test_figures_without_meaning_are_refused() -> None:
    for arguments in ((3.0, 50, 0), (3.0, 7, 6), (-1.0, 50, 6), (np.inf, 50, 6)):
        with pytest.raises(ValueError, match="must be"):
            adjusted_r2_of_f(*arguments)


def test_weights_on_the_rows_cancel() -> None:
    """Eq. (7) with a diagonal W and G free has the solution of Eq. (6), for noisy data and weights of any spread."""
    random = np.random.default_rng(7)
    delta_s = random.uniform(-1, 1, (12, 30))
    delta_c = 1e-6 * random.standard_normal((21, 30))
    size = np.abs(np.linalg.lstsq(delta_s.T, delta_c.T, rcond=None)[0]).max()
    for weights in (np.ones(21), np.geomspace(1e-3, 1, 21), random.uniform(0.1, 10, 21)):
        assert weights_cancel_max_abs(delta_c, delta_s, weights) < 1e-9 * size


def test_weights_on_the_columns_do_not_cancel() -> None:
    """The counterpart that shows the figure above to be one that can fail: weights on surfaces change G."""
    random = np.random.default_rng(8)
    delta_s, delta_c = random.uniform(-1, 1, (5, 20)), random.standard_normal((4, 20))
    plain = np.linalg.lstsq(delta_s.T, delta_c.T, rcond=None)[0]
    on_surfaces = np.geomspace(0.1, 1, 20)[:, None]
    weighted = np.linalg.lstsq(on_surfaces * delta_s.T, on_surfaces * delta_c.T, rcond=None)[0]
    assert np.abs(weighted - plain).max() > 1e-2 * np.abs(plain).max()


def test_what_does_not_determine_g_is_refused() -> None:
    random = np.random.default_rng(9)
    c, s, w = random.standard_normal((3, 8)), random.standard_normal((5, 8)), np.ones(3)
    with pytest.raises(ValueError, match="4 surfaces for 5 unknowns per row of G"):
        weights_cancel_max_abs(c[:, :4], s[:, :4], w)
    s[4] = 2 * s[3]
    with pytest.raises(ValueError, match="the signals span 4 of 5 directions"):
        weights_cancel_max_abs(c, s, w)
    s[4] = 0.0  # an actuator that stays where it is
    with pytest.raises(ValueError, match="some actuators never move"):
        weights_cancel_max_abs(c, s, w)
    with pytest.raises(ValueError, match="must be 3 finite numbers above 0"):
        weights_cancel_max_abs(c, s, np.array([1.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="as many columns"):
        weights_cancel_max_abs(c, s[:, 1:], w)
