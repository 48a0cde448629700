"""Zernike terms and converters against tables and integrals written out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dm_common.optics import zernike
from dm_common.optics.zernike import TERMS, basis

# (n, m, kind), R_n^m(r) as written in Born & Wolf table 9.1, Noll's j, OSA/ANSI j.
TABLE = [
    (0, 0, "", lambda r: 1 + 0 * r, 1, 0),
    (1, 1, "cos", lambda r: r, 2, 2),
    (1, 1, "sin", lambda r: r, 3, 1),
    (2, 0, "", lambda r: 2 * r**2 - 1, 4, 4),
    (2, 2, "cos", lambda r: r**2, 6, 5),
    (2, 2, "sin", lambda r: r**2, 5, 3),
    (3, 1, "cos", lambda r: 3 * r**3 - 2 * r, 8, 8),
    (3, 1, "sin", lambda r: 3 * r**3 - 2 * r, 7, 7),
    (3, 3, "cos", lambda r: r**3, 10, 9),
    (3, 3, "sin", lambda r: r**3, 9, 6),
    (4, 0, "", lambda r: 6 * r**4 - 6 * r**2 + 1, 11, 12),
    (4, 2, "cos", lambda r: 4 * r**4 - 3 * r**2, 12, 13),
    (4, 2, "sin", lambda r: 4 * r**4 - 3 * r**2, 13, 11),
    (4, 4, "cos", lambda r: r**4, 14, 14),
    (4, 4, "sin", lambda r: r**4, 15, 10),
    (5, 1, "cos", lambda r: 10 * r**5 - 12 * r**3 + 3 * r, 16, 18),
    (5, 1, "sin", lambda r: 10 * r**5 - 12 * r**3 + 3 * r, 17, 17),
    (5, 3, "cos", lambda r: 5 * r**5 - 4 * r**3, 18, 19),
    (5, 3, "sin", lambda r: 5 * r**5 - 4 * r**3, 19, 16),
    (5, 5, "cos", lambda r: r**5, 20, 20),
    (5, 5, "sin", lambda r: r**5, 21, 15),
]

R, THETA = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 2 * np.pi, 11, endpoint=False))
VALUES = [
    radial(R) * {"": 1.0, "cos": np.cos(m * THETA), "sin": np.sin(m * THETA)}[kind]
    for _n, m, kind, radial, _noll, _ansi in TABLE
]


def test_terms_are_in_the_papers_order() -> None:
    assert [tuple(term) for term in TERMS] == [row[:3] for row in TABLE]
    assert zernike.NAMES[3:6] == ("Z_2^0", "Z_2^2 cos", "Z_2^2 sin")
    assert zernike.NAMES[10] == "Z_4^0"


def test_basis_equals_the_table() -> None:
    found = basis(R * np.cos(THETA), R * np.sin(THETA))
    assert found.shape == (*R.shape, 21)
    np.testing.assert_allclose(found, np.stack(VALUES, axis=-1), atol=1e-13)


def test_rms_over_the_disc_is_the_integral() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(20)
    radius = np.sqrt((nodes + 1) / 2)
    angle = 2 * np.pi * np.arange(32) / 32
    terms = basis(np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)))
    gram = np.einsum("r,rak,ral->kl", weights / 64, terms, terms)
    np.testing.assert_allclose(gram, np.diag(zernike.TERM_RMS**2), atol=1e-14)


@pytest.mark.parametrize("convention", ["noll", "ansi"])
def test_converters_describe_the_same_surface(convention: str) -> None:
    converted = np.random.default_rng(3).normal(size=21)
    coefficients = zernike.to_born_wolf(converted, convention)
    surface = sum(c * value for c, value in zip(coefficients, VALUES, strict=True))
    again = np.zeros_like(R)
    for (n, m, _kind, _radial, noll, ansi), value in zip(TABLE, VALUES, strict=True):
        norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * (n + 1))
        again += converted[noll - 1 if convention == "noll" else ansi] * norm * value
    np.testing.assert_allclose(again, surface, atol=1e-12)
    # rms-normalised coefficients add up to the surface's rms directly
    assert np.linalg.norm(converted[1:]) == pytest.approx(np.linalg.norm((coefficients * zernike.TERM_RMS)[1:]))


def test_fringe_order_is_that_of_the_book() -> None:
    """J. C. Wyant and K. Creath, Basic wavefront aberration theory, table III: piston to secondary trefoil."""
    polar = [(0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3), (3, -3)]
    polar += [(4, 2), (4, -2), (5, 1), (5, -1), (6, 0), (4, 4), (4, -4), (5, 3), (5, -3)]
    index = {(term.n, -term.m if term.kind == "sin" else term.m): term.fringe_index for term in TERMS}
    assert [index.get(term, 16) for term in polar] == list(range(1, 21))
    assert (index[5, 5], index[5, -5]) == (26, 27)
    fringe = np.arange(1.0, 38.0)
    np.testing.assert_array_equal(zernike.to_born_wolf(fringe, "fringe"), [term.fringe_index for term in TERMS])


def test_wrong_number_of_coefficients_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(20,\).*21 terms"):
        zernike.to_born_wolf(np.zeros(20), "noll")


def test_rms_beyond_tilt_is_that_of_the_surface_without_its_plane() -> None:
    coefficients = np.random.default_rng(1).normal(size=len(TERMS))
    axis = np.linspace(-1, 1, 601)
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= 1
    sag = basis(x[inside], y[inside])[:, 3:] @ coefficients[3:]
    assert zernike.rms_beyond_tilt(coefficients, 0.5) == pytest.approx(np.hypot(sag.std(), 0.5), rel=0.01)
