"""The membrane of the virtual bench against closed forms of the Poisson equation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_simulation.mirror.membrane import EPSILON, Membrane, MembraneConfig

#: So wide a gap that the membrane's own way does not count, and a tension as small.
WIDE = {"gap": 1e-2, "tension": 5e-3, "gain_spread": 0.0}


def made(volts_max: float = 0.0, **changes: float) -> Membrane:
    config = MembraneConfig(**{**WIDE, **changes})  # type: ignore[arg-type]
    return Membrane(config, np.random.default_rng(3), volts_max=volts_max)


def sag(membrane: Membrane, volts: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    membrane.apply(volts, 0.0)
    return np.asarray(membrane.influence_at(x, np.zeros_like(x)) @ membrane.displacement)


def test_one_round_electrode_has_its_closed_form() -> None:
    """Pressure p within b: p b^2 / (2 T) log(a / r) beyond it; p (b^2 (1 + 2 log(a / b)) - r^2) / (4 T) within."""
    membrane = made()
    config, a = membrane.config, membrane.radius
    b, volts = config.electrode_diameter / 2, np.zeros(37)
    volts[0] = 200.0
    strength = EPSILON / 2 * (200.0 / config.gap) ** 2 / (4 * config.tension)
    r = np.linspace(0.0, 0.99 * a, 60)
    inside = b**2 * (1 + 2 * np.log(a / b)) - r**2
    beyond = 2 * b**2 * np.log(a / np.maximum(r, b))
    found = sag(membrane, volts, r)
    # A polynomial of degree 36 rounds off the edge of the electrode.
    np.testing.assert_allclose(found, -strength * np.where(r < b, inside, beyond), atol=0.02 * np.abs(found).max())
    np.testing.assert_allclose(found[r > 3 * b], (-strength * beyond)[r > 3 * b], atol=3e-3 * np.abs(found).max())
    assert membrane.influence_at(np.array([a]), np.zeros(1)) == pytest.approx(0.0, abs=1e-12)


def test_push_and_answer_can_be_exchanged() -> None:
    membrane = made()
    at_electrodes = membrane.influence_at(membrane.x, membrane.y)
    np.testing.assert_allclose(at_electrodes, at_electrodes.T, atol=1e-3 * np.abs(at_electrodes).max())


def test_it_answers_to_the_square_of_the_volts_and_is_only_pulled() -> None:
    membrane, x = made(), np.linspace(-4e-3, 4e-3, 9)
    pattern = np.random.default_rng(1).uniform(0.2, 1.0, 37)
    one, two = (sag(membrane, volts * pattern, x) for volts in (100.0, 200.0))
    np.testing.assert_allclose(two, 4.0 * one, rtol=5e-4)
    assert (one < 0.0).all()
    np.testing.assert_array_equal(sag(membrane, -100.0 * pattern, x), one)


@pytest.mark.slow
def test_the_nearer_it_comes_the_more_it_is_pulled_and_it_must_not_fall_onto_the_electrodes() -> None:
    centre = np.zeros(1)
    near = made(gap=1e-4, tension=60.0)
    low, high = (-sag(near, np.full(37, volts), centre)[0] for volts in (30.0, 300.0))
    assert 1.1 * 100 * low < high < 0.1 * near.config.gap
    with pytest.raises(ValueError, match=r"membrane\.tension = 5 N/m: must be larger, since 300 V pull"):
        made(gap=1e-4, tension=5.0, volts_max=300.0)


@pytest.mark.slow
def test_the_zero_drifts_to_its_end() -> None:
    membrane = made(drift=2e-7, drift_time=100.0)
    membrane.apply(np.zeros(37), 0.0)

    def figure(time: float) -> NDArray[np.float64]:
        membrane.advance(time)
        return np.asarray(membrane.influence_at(membrane.x, membrane.y) @ membrane.displacement)

    np.testing.assert_array_equal(figure(0.0), 0.0)
    assert np.abs(figure(1e4)).max() == pytest.approx(2e-7)
    assert np.abs(figure(-1e5)).max() == pytest.approx(2e-7), "a clock that jumps back"
    early = made(drift=2e-7, drift_time=100.0)
    early.advance(100.0)
    drifted = early.influence_at(early.x, early.y) @ early.displacement
    np.testing.assert_allclose(drifted, (1 - np.exp(-1)) * figure(1e4))


def test_electrodes_beyond_the_edge_are_refused() -> None:
    with pytest.raises(ValueError, match=r"membrane\.pitch = 0\.0024 m: electrodes beyond the edge"):
        made(pitch=2.4e-3)
    with pytest.raises(ValueError, match=r"membrane\.actuators = 8: full rings hold .*; a plate takes others"):
        made(actuators=8)
