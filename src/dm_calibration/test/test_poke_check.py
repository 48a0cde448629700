"""What the poke check finds when wiring, orientation or polarity differ from the configuration."""

from __future__ import annotations

import re
import resource

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dm_calibration.influence.poke_check import PokeCheck, _doubled, check_pokes, cycles
from linear_mirror import RADIUS, LinearMirror, hexagon

X, Y = hexagon()
PLANT = LinearMirror(X, Y)
NOISE = 3e-9
NONE = np.zeros(37, dtype=bool)


def response(x: np.ndarray = X, y: np.ndarray = Y, length: float = 2.6e-3, seed: int = 0) -> np.ndarray:
    """(P, N) measured response of actuators that really stand at x, y, with noise and unknown piston and tilt."""
    random = np.random.default_rng(seed)
    plant = LinearMirror(x, y, length=length)
    planes = plant.modes[:, :3] @ (1e-6 * random.standard_normal((3, x.size)))
    return np.asarray(plant.influence + planes + NOISE * random.standard_normal(plant.influence.shape))


def check(measured: np.ndarray, silent: np.ndarray = NONE, unmoved: np.ndarray = NONE) -> PokeCheck:
    return check_pokes(measured, PLANT.points, X, Y, RADIUS, silent=silent, unmoved=unmoved)


@pytest.mark.parametrize("length", [1.5e-3, 2.0e-3, 2.6e-3, 3.5e-3])
def test_nothing_is_found_when_all_agrees(length: float) -> None:
    result = check(response(length=length))
    assert result.passed
    assert result.findings == ()
    assert (result.place == np.arange(37)).all()


@pytest.mark.parametrize("length", [1.5e-3, 2.0e-3, 2.6e-3, 3.5e-3])
def test_a_sensor_that_sees_the_terms_alone_finds_nothing_else(length: float) -> None:
    order = np.arange(37)
    order[[2, 6]] = order[[6, 2]]
    terms, root = PLANT.modes, np.sqrt(PLANT.points.weight)[:, None]
    seen = terms @ np.linalg.lstsq(root * terms, root * response(*seen_positions(-0.82), length), rcond=None)[0]
    result = check(seen[:, order])
    assert result.registration is not None and result.registration.turn == pytest.approx(-0.82, abs=0.01)
    assert len(result.findings) == 2 and result.findings[-1] == "actuators 3 and 7 are exchanged"


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
        "actuators 5, 10, 31 are permuted: "
        "5 moves the surface at 10, 10 moves the surface at 31, 31 moves the surface at 5",
    )


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.permutations(range(37)), st.integers(0, 1000))
def test_any_wiring_is_found(order: list[int], seed: int) -> None:
    result = check(response(seed=seed)[:, order])
    assert result.place.tolist() == order
    assert result.passed == (order == sorted(order))


@pytest.mark.parametrize(("own", "other", "two"), [(0.977, 0.630, False), (0.9, 0.750, True)])
def test_a_bump_of_another_shape_at_the_rim_does_not_count_as_two(own: float, other: float, two: bool) -> None:
    """An elliptical one beside the aperture, which one round bump explains to 95 % and two to 98 %."""
    overlap, height = np.array([[1.0, 0.5], [0.5, 1.0]]), np.array([1.0, 0.4])
    assert _doubled(np.array([[own, other], [0.5, 1.0]]), overlap, height) == ({0: (0, 1)} if two else {})


#: Inner and outer radius of the rings of patches of bimorphs, in half diameters of the plate, and their numbers.
RINGS = {
    "19 patches": ((0.0, 0.2, 0.45, 0.7), (1, 6, 12)),
    "37 patches": ((0.0, 0.12, 0.32, 0.55, 0.8), (1, 6, 12, 18)),
    "7 patches, most beyond the aperture": ((0.0, 0.5, 1.0), (1, 6)),
    "19 wide patches, most beyond the aperture": ((0.0, 0.35, 0.75, 1.0), (1, 6, 12)),
    "28 wide patches, most beyond the aperture": ((0.1, 0.35, 0.65, 0.95), (4, 8, 16)),
}


def bimorph(rings: str, aperture: float, free: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(P, N) sag for patches that bend a disc held at its edge, by the Poisson equation, and their centres (N,), m.

    Args:
        aperture: its radius, in half diameters of the plate.
        free: nothing holds the edge, where moment and shear force of a plate then vanish; Poisson's ratio is 0.3.
    """
    radii, counts = RINGS[rings]
    at = aperture * (PLANT.points.x + 1j * PLANT.points.y)
    sag, centres = [], []
    for inner, outer, count in zip(radii[:-1], radii[1:], counts, strict=True):
        radius = np.sqrt(np.linspace(inner**2, outer**2, 25)[:-1] + (outer**2 - inner**2) / 48)  # of equal areas
        for number in range(count):
            angle = 2 * np.pi * (number + (np.arange(24) + 0.5) / 24) / count
            patch = (radius[:, None] * np.exp(1j * angle)).ravel()[:, None]
            image = 1 - patch.conj() * at
            edge = np.log(np.abs(image))
            if free:
                edge = 0.7 / 3.3 * ((1 - np.abs(at) ** 2) * (1 / image).real - edge)
                edge -= (0.7 / 2.6 - 0.7 / 3.3) * np.abs(at) ** 2
            sag.append((edge - np.log(np.abs(patch - at))).mean(axis=0))
            centres.append(patch.mean() * RADIUS / aperture)
    return np.array(sag).T / np.max(sag) * 1e-6, np.array(centres)


@pytest.mark.parametrize(
    ("rings", "aperture", "free"),
    [
        ("19 patches", 0.5, False),
        ("19 patches", 0.7, False),
        ("37 patches", 0.6, False),
        (list(RINGS)[-1], 0.5, False),
        ("19 patches", 0.6, True),
        ("37 patches", 0.6, True),
        (list(RINGS)[-1], 0.6, True),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 0.85])
def test_a_bimorph_leans_towards_the_middle_and_is_not_taken_for_a_smaller_one(
    rings: str, aperture: float, free: bool, scale: float
) -> None:
    sag, centres = bimorph(rings, aperture, free)
    configured = np.exp(-0.5j) * -centres.conj() / scale  # the maps show it mirrored and turned
    order = np.arange(centres.size)
    order[[3, 8]] = order[[8, 3]]
    none = np.zeros(centres.size, dtype=bool)
    sag = sag[:, order] + NOISE * np.random.default_rng(1).standard_normal(sag.shape)
    result = check_pokes(sag, PLANT.points, configured.real, configured.imag, RADIUS, silent=none, unmoved=none)
    mirrored, *wrong_scale, exchanged = result.findings
    assert mirrored.startswith("the maps show the mirror mirrored left to right, then turned by ")
    assert exchanged == "actuators 4 and 9 are exchanged"
    assert len(wrong_scale) == (scale != 1.0)
    assert result.registration is not None and result.registration.scale == pytest.approx(scale, rel=0.03)


def test_a_bimorph_or_membrane_may_lower_the_surface_but_all_of_it_alike() -> None:
    """Electrodes pull a membrane, and no convention says which way a patch bends a plate."""
    sag, centres = bimorph("37 patches", 0.6)
    sag = NOISE * np.random.default_rng(1).standard_normal(sag.shape) - sag
    x, y = centres.real, centres.imag
    assert check_pokes(sag, PLANT.points, x, y, RADIUS, silent=NONE, unmoved=NONE).findings == ()
    sag[:, 8] *= -1.0
    (found,) = check_pokes(sag, PLANT.points, x, y, RADIUS, silent=NONE, unmoved=NONE).findings
    assert found.startswith("actuator 9 moves the opposite way to most others, which lower the surface")


@pytest.mark.parametrize(("rings", "aperture"), [(list(RINGS)[2], 0.5), (list(RINGS)[2], 0.6), (list(RINGS)[3], 0.4)])
def test_patches_far_beyond_the_aperture_are_not_sought_ever_further_away(rings: str, aperture: float) -> None:
    """The surface of a far patch hardly depends on its distance, nor on that of the edge beyond it."""
    sag, centres = bimorph(rings, aperture)
    none = np.zeros(centres.size, dtype=bool)
    sag += NOISE * np.random.default_rng(1).standard_normal(sag.shape)
    result = check_pokes(sag, PLANT.points, centres.real, centres.imag, RADIUS, silent=none, unmoved=none)
    assert result.findings == ()
    assert result.registration is not None and result.registration.scale == pytest.approx(1.0, abs=0.1)


def seen_positions(
    turn: float, mirrored: bool = False, shift: complex = 0.0, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Where the actuators are seen, m."""
    places = X + 1j * Y
    seen = scale * np.exp(1j * turn) * (-places.conj() if mirrored else places) + shift
    return seen.real, seen.imag


def same_turn(found: float, turn: float) -> float:
    """Difference of two angles where turns by 60 degrees look alike, rad."""
    return abs((found - turn + np.pi / 6) % (np.pi / 3) - np.pi / 6)


@pytest.mark.parametrize("degrees", [60, 120, 180, 240, 300, 35, -100])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_turned_mirror_is_one_finding(degrees: float, mirrored: bool) -> None:
    """Not thirty exchanged actuators, also where the numbering could as well begin elsewhere."""
    result = check(response(*seen_positions(np.radians(degrees), mirrored)))
    assert len(result.findings) == 1 and result.turned
    assert result.registration is not None
    assert np.angle(np.exp(1j * (result.registration.turn - np.radians(degrees)))) == pytest.approx(0.0, abs=0.005)
    assert result.registration.mirrored == mirrored == ("mirrored" in result.findings[0])
    assert (result.place == np.arange(37)).all()


def test_the_sentence_gives_turn_image_shift_and_their_errors() -> None:
    findings = check(response(*seen_positions(np.radians(35.0), True, 1.2e-3 - 0.5e-3j))).findings
    assert len(findings) == 1
    pattern = (
        r"the maps show the mirror mirrored left to right, then turned by (35\.0|34\.9)\d \+- 0\.\d\d degrees "
        r"counter-clockwise and shifted by \+1\.[12]\d mm in x and -0\.[45]\d mm in y, \+- 0\.0\d mm"
    )
    assert re.fullmatch(pattern, findings[0]), findings[0]


TURNS, SHIFTS, SCALES = st.floats(-np.pi, np.pi), st.floats(-1.5e-3, 1.5e-3), st.floats(0.98, 1.02)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(TURNS, st.booleans(), st.tuples(SHIFTS, SHIFTS), SCALES, st.integers(0, 10**6), st.booleans())
def test_any_mounting_with_any_numbering(
    turn: float, mirrored: bool, shift: tuple[float, float], scale: float, seed: int, by_rings: bool
) -> None:
    """Rings begun at another actuator, or no order at all: each is found where it stands, by whichever turn."""
    random = np.random.default_rng(seed)
    rings = np.split(np.arange(37), [1, 7, 19])
    begun = np.concatenate([np.roll(ring, random.integers(ring.size)) for ring in rings])
    order = begun if by_rings else random.permutation(37)
    x, y = seen_positions(turn, mirrored, complex(*shift), scale)
    result = check(response(x[order], y[order], seed=seed))
    registration = result.registration
    assert registration is not None
    found_x, found_y = seen_positions(
        registration.turn, registration.mirrored, complex(*registration.shift), registration.scale
    )
    apart = np.hypot(found_x[result.place] - x[order], found_y[result.place] - y[order])
    assert apart.max() < 1e-4, result.pose


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    TURNS,
    st.booleans(),
    st.tuples(SHIFTS, SHIFTS),
    SCALES,
    st.integers(0, 10**6),
    st.lists(st.sampled_from(["dead", "weak", "inverted", "doubled", "crossed"]), max_size=5),
)
@example(0.0, False, (0.0, 0.0), 1.0, 124, ["dead", "dead", "dead", "weak"])  # the centre, alone in its ring
def test_any_mounting_with_any_faults(
    turn: float, mirrored: bool, shift: tuple[float, float], scale: float, seed: int, faults: list[str]
) -> None:
    random = np.random.default_rng(seed)
    shift_m = complex(*shift)
    measured = response(*seen_positions(turn, mirrored, shift_m, scale), seed=seed)
    left, place = list(random.permutation(37)), np.arange(37)
    expected: list[str] = []
    weak: list[int] = []
    silent = np.zeros(37, dtype=bool)
    for fault in faults:
        one, other = (int(left.pop()) for _ in range(2))
        numbers = sorted((one + 1, other + 1))
        if fault == "dead":
            silent[one] = True
            measured[:, one] = NOISE * random.standard_normal(len(measured))
        elif fault == "weak":
            measured[:, one] *= 0.2
            weak.append(one + 1)
        elif fault == "inverted":
            measured[:, one] *= -1.0
            expected.append("opposite")
        elif fault == "doubled":  # two actuators on one channel, none on the other
            measured[:, one] += measured[:, other]
            silent[other] = True
            expected.append(f"actuator {one + 1} moves the surface at actuators {numbers[0]} and {numbers[1]} together")
        else:
            measured[:, [one, other]] = measured[:, [other, one]]
            place[[one, other]] = other, one
            expected.append(f"actuators {numbers[0]} and {numbers[1]} are exchanged")
    result = check(measured, silent=silent)
    registration = result.registration
    assert registration is not None and registration.mirrored == mirrored
    turned, moved = np.angle(np.exp(1j * (registration.turn - turn))), abs(complex(*registration.shift) - shift_m)
    assert abs(turned) < 0.01 and moved < 1e-4 and abs(registration.scale - scale) < 0.01, result.pose
    assert result.place.tolist() == place.tolist()
    text = "; ".join(result.findings)
    assert all(words in text for words in expected), text
    assert ("no response" in text) == bool(silent.any())
    named = re.findall(r"actuators? ([\d, ]+) answers? weakly", text)
    assert [int(number) for number in ", ".join(named).split(",") if number] == sorted(weak)
    # And nothing that is not so.
    assert text.count("exchanged") == faults.count("crossed") and text.count("together") == faults.count("doubled")
    assert "permuted" not in text and "does not look like" not in text


def test_without_noise_nothing_differs() -> None:
    assert check(PLANT.influence).passed


@pytest.mark.slow
def test_an_arrangement_without_symmetry() -> None:
    """Actuators in the shape of an F: each turn and image is told from all others."""
    grid = np.array([(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 4), (2, 4), (1, 2)])
    places = 4e-3 * (grid[:, 0] - 1 + 1j * (grid[:, 1] - 2))
    for degrees in (0, 90, 180, 270, 35):
        for mirrored in (False, True):
            seen = np.exp(1j * np.radians(degrees)) * (-places.conj() if mirrored else places)
            measured = response(seen.real, seen.imag, length=1.8e-3)
            result = check_pokes(
                measured, PLANT.points, places.real, places.imag, RADIUS, silent=NONE[:8], unmoved=NONE[:8]
            )
            assert result.registration is not None and (result.place == np.arange(8)).all()
            assert result.registration.mirrored == mirrored
            assert result.passed == (degrees == 0 and not mirrored)
            assert np.exp(1j * result.registration.turn) == pytest.approx(np.exp(1j * np.radians(degrees)), abs=0.03)


@pytest.mark.parametrize("scale", [0.85, 1.1])
def test_a_scale_that_contradicts_the_pitch(scale: float) -> None:
    findings = check(response(*seen_positions(0.0, scale=scale))).findings
    assert len(findings) == 1
    seen = re.search(r"actuators (\S+) \+- 0\.0\d mm apart, configured are 4\.30 mm: correct the lateral", findings[0])
    assert seen and float(seen[1]) == pytest.approx(4.3 * scale, rel=0.015)


def test_pokes_too_small_to_see() -> None:
    silent = np.arange(37) % 5 != 0
    findings = check(response(), silent=silent).findings
    assert "only 8 of 37 actuators answer above the noise: the pokes are too small" in findings[0]
    assert "mirror.channels" in findings[0]
    # Two that answer as they should say nothing of the pokes.
    for moved, text in ((1, "1 actuator was"), (2, "2 actuators were")):
        findings = check(response(), unmoved=np.arange(37) >= moved).findings
        assert findings == (f"{text} moved: a check of wiring and orientation needs 3",)


def test_maps_that_show_something_else() -> None:
    """A third of the pupil stretched over the aperture: the places seen are not those of the mirror."""
    measured = response(*seen_positions(0.0, shift=2.2e-2 + 0j, scale=3.0))
    findings = check(measured).findings
    assert any("do not fit the configured positions" in finding for finding in findings), findings


@pytest.mark.parametrize("driven", [[0], [5], [20], [0, 1], [5, 20]])
def test_all_channels_on_the_same_place(driven: list[int]) -> None:
    result = check(response()[:, np.resize(driven, 37)])
    assert "all channels move the same one or two places: check the wiring" in result.findings[0]
    assert result.registration is None


def test_every_channel_moves_a_second_place() -> None:
    moved, measured = [5, 20, 31], response()
    measured[:, moved] += PLANT.influence[:, [8, 25, 27]]
    assert "together" in " ".join(check(measured, unmoved=~np.isin(np.arange(37), moved)).findings)


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


@pytest.mark.parametrize("moved", [[0, 1, 2], [13, 14, 33], [8, 11, 13, 20]])
def test_a_few_actuators_moved_do_not_stand_otherwise(moved: list[int]) -> None:
    assert check(response(), unmoved=~np.isin(np.arange(37), moved)).findings == ()


def test_dead_actuator_and_exchanged_pair() -> None:
    order = np.arange(37)
    order[[2, 6]] = order[[6, 2]]
    measured = response()[:, order]
    silent = np.arange(37) == 12
    findings = check(measured, silent=silent).findings
    assert findings == ("actuator 13 shows no response above the noise", "actuators 3 and 7 are exchanged")


def test_actuators_beside_a_displaced_aperture_are_not_called_dead() -> None:
    silent = np.arange(37) == 22
    quiet, pose = check(response(*seen_positions(0.0, False, 1.2e-3 - 0.5e-3j)), silent=silent).findings
    assert (
        quiet
        == "actuator 23 shows no response above the noise in the maps as they are now: check again once they "
        + ("are corrected")
    )
    assert "the maps show the mirror shifted by" in pose


def test_a_response_like_no_actuator_is_named() -> None:
    measured = response()
    measured[:, 3] = 1e-6 * np.sin(25.0 * PLANT.points.x)
    for sign in (1.0, -1.0):
        measured[:, 3] *= sign
        findings = check(measured).findings
        assert any("actuator 4 answers in a way that does not look like that of one actuator" in f for f in findings)
        assert not any("opposite" in finding for finding in findings), findings
    every = check(-measured).findings
    assert sum("all actuators move the surface the opposite way" in finding for finding in every) == 1, every


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"response has the shape \(300, 36\): must be \(300, 37\)"):
        check(response()[:, :36])


def test_cycles() -> None:
    assert cycles(np.array([0, 2, 1, 4, 5, 3])) == [(1, 2), (3, 4, 5)]


@pytest.mark.parametrize("slip", [0.05, 0.02])
def test_a_slip_in_the_pitch_is_told_and_does_not_fill_the_memory(slip: float) -> None:
    """At a twentieth of the pitch 6 GB were taken, at a hundredth 66 GB asked for."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = check_pokes(response(), PLANT.points, slip * X, slip * Y, RADIUS, silent=NONE, unmoved=NONE)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1e6, "less than 1 GB"
    assert any("mirror.pitch" in finding for finding in result.findings), result.findings
