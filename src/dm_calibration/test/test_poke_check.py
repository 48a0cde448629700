"""What the poke check finds when wiring, orientation or polarity differ from the configuration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_calibration.influence.poke_check import PokeCheck, check_pokes, cycles, layout_symmetries
from linear_mirror import RADIUS, LinearMirror, hexagon

X, Y = hexagon()
PLANT = LinearMirror(X, Y)
NOISE = 3e-9


def response(x: np.ndarray = X, y: np.ndarray = Y, length: float = 2.6e-3, seed: int = 0) -> np.ndarray:
    """(P, N) measured response of actuators that really stand at x, y, with noise and unknown piston and tilt."""
    random = np.random.default_rng(seed)
    plant = LinearMirror(x, y, length=length)
    planes = plant.modes[:, :3] @ (1e-6 * random.standard_normal((3, x.size)))
    return np.asarray(plant.influence + planes + NOISE * random.standard_normal(plant.influence.shape))


def check(measured: np.ndarray, **options: np.ndarray) -> PokeCheck:
    return check_pokes(measured, PLANT.points, X / RADIUS, Y / RADIUS, **options)


@pytest.mark.parametrize("length", [1.5e-3, 2.0e-3, 2.6e-3, 3.5e-3])
def test_nothing_is_found_when_all_agrees(length: float) -> None:
    result = check(response(length=length))
    assert result.passed
    assert result.findings == ()
    assert (result.place == np.arange(37)).all()
    assert (result.sign == 1).all()
    # The corners of ring 3 stand at 12.9 mm, outside the aperture of 11 mm.
    assert result.likeness.min() > 0.7


def test_exchanged_pair() -> None:
    order = np.arange(37)
    order[[2, 6]] = order[[6, 2]]
    assert check(response()[:, order]).findings == ("actuators 3 and 7 are exchanged",)


def test_exchanged_pair_outside_the_aperture() -> None:
    order = np.arange(37)
    order[[19, 28]] = order[[28, 19]]
    assert check(response()[:, order]).findings == ("actuators 20 and 29 are exchanged",)


def test_neighbours_on_the_outer_ring() -> None:
    order = np.arange(37)
    order[[19, 20]] = order[[20, 19]]
    assert check(response()[:, order]).findings == ("actuators 20 and 21 are exchanged",)


def test_cycle_of_three() -> None:
    order = np.arange(37)
    order[[4, 9, 30]] = order[[9, 30, 4]]
    assert check(response()[:, order]).findings == (
        "actuators 5, 10, 31 are permuted: 5 moves the place of 10, 10 moves the place of 31, 31 moves the place of 5",
    )


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(37)), st.integers(0, 1000))
def test_any_wiring_is_found(order: list[int], seed: int) -> None:
    result = check(response(seed=seed)[:, order])
    assert result.place.tolist() == order
    assert result.passed == (order == sorted(order))


@pytest.mark.parametrize("k", [1, 2, 3, 4, 5])
def test_pattern_turned_by_multiples_of_60_degrees(k: int) -> None:
    turned = (X + 1j * Y) * np.exp(1j * np.pi / 3 * k)
    findings = check(response(turned.real, turned.imag)).findings
    assert len(findings) == 1
    assert f"turned by {60 * k} degrees counter-clockwise" in findings[0]


@pytest.mark.parametrize("axis_deg", [0, 30, 60, 90, 120, 150])
def test_pattern_mirrored(axis_deg: int) -> None:
    mirrored = np.conj(X + 1j * Y) * np.exp(2j * np.radians(axis_deg))
    findings = check(response(mirrored.real, mirrored.imag)).findings
    assert len(findings) == 1
    assert f"mirrored about the axis at {axis_deg} degrees" in findings[0]


def test_turned_pattern_with_an_exchanged_pair() -> None:
    turned = (X + 1j * Y) * np.exp(1j * np.pi / 3)
    order = np.arange(37)
    order[[10, 16]] = order[[16, 10]]
    findings = check(response(turned.real, turned.imag)[:, order]).findings
    assert len(findings) == 2
    assert "turned by 60 degrees" in findings[0]
    assert findings[1] == "actuators 11 and 17 are exchanged"


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        (-Y, X, "turned by 90 degrees counter-clockwise"),
        (Y, -X, "turned by 90 degrees clockwise"),
        (Y, X, "mirrored about the rising diagonal"),
        (-Y, -X, "mirrored about the falling diagonal"),
    ],
)
def test_map_turned_by_a_quarter(x: np.ndarray, y: np.ndarray, words: str) -> None:
    result = check(response(x, y))
    assert len(result.findings) == 1
    assert words in result.findings[0]
    assert (result.place == np.arange(37)).all()


def test_f_shape_tells_the_orientations_apart() -> None:
    """Actuators in the shape of an F have no symmetry: all eight orientations are told, and none is confused."""
    grid = [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 4), (2, 4), (1, 2)]
    x, y = (np.array([p[i] for p in grid], dtype=float) * 4e-3 for i in (0, 1))
    x, y = x - 4e-3, y - 8e-3
    assert layout_symmetries(x, y) == []
    seen = set()
    for sx, sy, swap in [(a, b, c) for a in (1, -1) for b in (1, -1) for c in (False, True)]:
        u, v = (sx * x, sy * y) if not swap else (sy * y, sx * x)
        result = check_pokes(response(u, v, length=1.8e-3), PLANT.points, x / RADIUS, y / RADIUS)
        seen.add(result.orientation)
        assert (result.place == np.arange(8)).all()
        assert result.passed == (result.orientation == "as configured")
    assert len(seen) == 8


def test_inverted_signs() -> None:
    assert "all actuators move the surface the opposite way" in check(-response()).findings[0]
    one = response()
    one[:, 8] *= -1.0
    assert check(one).findings == ("actuator 9 moves the surface the opposite way",)
    most = -response()
    most[:, [3, 20]] *= -1.0
    assert "actuators 4, 21 move the opposite way to most others" in check(most).findings[0]


def test_dead_actuators_do_not_confuse_the_others() -> None:
    measured = response()
    silent = np.zeros(37, dtype=bool)
    silent[[5, 25]] = True
    measured[:, silent] = NOISE * np.random.default_rng(1).standard_normal((measured.shape[0], 2))
    assert check(measured, silent=silent).findings == ("actuators 6, 26 show no response above the noise",)
    assert check(measured, silent=np.zeros(37, dtype=bool), unmoved=silent).passed


def test_dead_actuator_and_exchanged_pair() -> None:
    order = np.arange(37)
    order[[2, 6]] = order[[6, 2]]
    measured = response()[:, order]
    silent = np.arange(37) == 12
    findings = check(measured, silent=silent).findings
    assert findings == ("actuator 13 shows no response above the noise", "actuators 3 and 7 are exchanged")


def test_a_response_like_no_actuator_is_named() -> None:
    measured = response()
    measured[:, 3] = 1e-6 * np.sin(25.0 * PLANT.points.x)
    findings = check(measured).findings
    assert any("actuator 4 answers in a way that does not look like that of one actuator" in f for f in findings)


def test_too_few_answers() -> None:
    silent = np.arange(37) > 1
    findings = check(response(), silent=silent).findings
    assert "only 2 actuators answer" in findings[-1]


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"response has the shape \(300, 36\): must be \(300, 37\)"):
        check(response()[:, :36])


def test_symmetries_of_a_hexagon() -> None:
    found = layout_symmetries(X, Y)
    assert len(found) == 11
    assert all(sorted(permutation.tolist()) == list(range(37)) for _, permutation in found)


def test_cycles() -> None:
    assert cycles(np.array([0, 2, 1, 4, 5, 3])) == [(1, 2), (3, 4, 5)]
