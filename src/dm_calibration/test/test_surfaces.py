"""Table 1 in [1], surface by surface."""

from __future__ import annotations

import numpy as np
import pytest

from dm_calibration.influence import surfaces
from dm_common.errors import UnknownNameError
from dm_common.mirror import Mirror
from dm_common.optics.zernike import NAMES, TERMS
from linear_mirror import LinearMirror, make_mirror


class Model:
    """A linear model known exactly."""

    def __init__(self, plant: LinearMirror, flat: bool = False) -> None:
        self.influence_sag = plant.influence
        self.points = plant.points
        self.sag_offset = np.zeros(plant.points.x.size) if flat else plant.modes @ plant.figure_coefficients


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return make_mirror()


@pytest.fixture(scope="module")
def plant(mirror: Mirror) -> LinearMirror:
    return LinearMirror(mirror.x, mirror.y)


def test_table_1_has_69_names_in_order() -> None:
    expected = [f"p{k:02d}" for k in range(1, 59)] + [f"pz{k:02d}" for k in range(1, 12)]
    assert list(surfaces.TABLE_1) == expected
    assert len(expected) == 69


def test_signal_surfaces_are_those_of_the_table(mirror: Mirror) -> None:
    def signals(name: str) -> list[float]:
        return surfaces.signal_surface(name, mirror).signals.tolist()

    for name, level in zip(("p01", "p02", "p03", "p04", "p05"), (-1.0, -0.5, 0.0, 0.5, 1.0), strict=True):
        assert signals(name) == [level] * 37
    for channel in range(1, 38):
        expected = [-1.0] * 37
        expected[channel - 1] = 1.0
        assert signals(f"p{5 + channel:02d}") == expected
    for name, first, last in (("p43", 2, 7), ("p44", 8, 19), ("p45", 20, 37)):
        assert signals(name) == [1.0 if first <= k <= last else -1.0 for k in range(1, 38)]
    for k, value in enumerate((-0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8)):
        assert signals(f"p{46 + k}") == [value] + [-1.0] * 36


def test_unknown_names_are_refused_with_near_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"surface 'pz12' is unknown; did you mean .*pz1"):
        surfaces.check_names(["p01", "pz12"])
    assert surfaces.check_names(["pz01", "p02", "p02"]) == ("p02", "pz01")
    assert surfaces.check_names([]) == surfaces.TABLE_1


def test_surfaces_a_smaller_mirror_cannot_have() -> None:
    small = make_mirror(rings=2)
    assert small.actuators == 19
    assert surfaces.missing_on("p24", small) == ""
    assert surfaces.missing_on("p25", small) == "p25 moves actuator 20; the mirror has 19"
    assert surfaces.missing_on("p45", small) == "p45 moves circle 4 of actuators; the mirror has 3"
    assert (surfaces.signal_surface("p44", small).signals == np.where(small.rings == 2, 1.0, -1.0)).all()


def test_neighbour_limit_scales_about_the_mean_and_says_so() -> None:
    limited = make_mirror(neighbour_difference_max=1.0)
    surface = surfaces.signal_surface("p06", limited)
    exact = surfaces.signal_surface("p06", make_mirror()).signals
    assert surface.signals.mean() == pytest.approx(exact.mean())
    assert surface.signals - exact.mean() == pytest.approx(0.5 * (exact - exact.mean()))
    assert "50%" in surface.remark
    assert surfaces.signal_surface("p06", make_mirror()).remark == ""


@pytest.mark.parametrize(("name", "radius"), [("p55", 60.0), ("p56", -60.0), ("p57", 100.0), ("p58", -100.0)])
def test_spheres_have_their_curvature(name: str, radius: float, mirror: Mirror, plant: LinearMirror) -> None:
    model = Model(plant)
    surface = surfaces.model_surface(name, model, mirror)
    assert surface.nominal is not None
    # Sag r^2 / 2R of a shallow sphere is a defocus of r^2 / 4R in peak-normalised terms.
    assert surface.nominal[NAMES.index("Z_2^0")] == pytest.approx(mirror.working_radius**2 / (4.0 * radius), rel=1e-4)
    reached = plant.fit_terms(model.influence_sag @ surface.signals + model.sag_offset)
    assert reached[3:] == pytest.approx(surface.nominal[3:], abs=20e-9)
    assert mirror.limits.allow(surface.signals)


@pytest.mark.parametrize("name", [f"pz{k:02d}" for k in range(2, 12)])
def test_zernike_surfaces_aim_at_one_term(name: str, mirror: Mirror, plant: LinearMirror) -> None:
    model = Model(plant, flat=True)
    surface = surfaces.model_surface(name, model, mirror)
    assert surface.nominal is not None
    wanted = surfaces.ZERNIKE_NAMES[int(name[2:]) - 1]
    index = int(np.flatnonzero(surface.nominal)[0])
    assert np.count_nonzero(surface.nominal) == 1
    assert TERMS[index].name.removesuffix(" cos") == wanted
    assert wanted in surface.target
    assert surface.remark == ""
    # Half of what the limits allow: the furthest actuator stands near half range, and the shape is mostly that term.
    assert 0.35 <= np.abs(surface.signals).max() <= 0.65
    reached = plant.fit_terms(model.influence_sag @ surface.signals)
    reached[:3] = 0.0
    assert int(np.abs(reached).argmax()) == index
    assert reached[index] == pytest.approx(surface.nominal[index], rel=0.12)


def test_tilt_surface_moves_the_actuators_in_a_plane(mirror: Mirror, plant: LinearMirror) -> None:
    surface = surfaces.model_surface("pz01", Model(plant, flat=True), mirror)
    slope = surface.signals @ mirror.x / (mirror.x @ mirror.x)
    assert surface.signals == pytest.approx(slope * mirror.x, abs=1e-9)
    assert np.abs(surface.signals).max() == pytest.approx(0.5, abs=0.01)


def test_limited_spheres_record_what_they_became(plant: LinearMirror) -> None:
    limited = make_mirror(neighbour_difference_max=0.05)
    surface = surfaces.model_surface("p55", Model(plant), limited)
    assert limited.limits.allow(surface.signals)
    assert "reduced to" in surface.remark
    free = surfaces.model_surface("p55", Model(plant), make_mirror())
    assert surface.nominal is not None and free.nominal is not None
    factor = surface.nominal[3] / free.nominal[3]
    assert 0.0 < factor < 1.0
    assert surface.signals - surface.signals.mean() == pytest.approx(
        factor * (free.signals - free.signals.mean()), abs=1e-6
    )


def test_bounded_solve_beats_clipping(mirror: Mirror, plant: LinearMirror) -> None:
    model = Model(plant, flat=True)
    coefficients = np.zeros(21)
    coefficients[NAMES.index("Z_2^2 cos")] = 9e-6
    target = plant.modes @ coefficients
    signals, left = surfaces.solve_shape(target, model, mirror)
    assert np.abs(signals).max() <= 1.0
    clipped = np.clip(np.linalg.lstsq(model.influence_sag, target, rcond=None)[0], -1.0, 1.0)
    difference = surfaces.remove_piston_tilt((target - model.influence_sag @ clipped)[None], model.points)[0]
    assert left < float(np.sqrt(np.square(difference) @ model.points.weight))
