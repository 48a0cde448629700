"""Thin optics against ray matrices, round trips and limits."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dm_autofocus.autofocus_parameters import PARAMETERS, focus_lens
from dm_autofocus.optics import (
    FocusOptics,
    OpticsError,
    depth_of_focus,
    dioptre_of,
    distance_of,
    rest_dioptre_of_lens,
)

DIOPTRES = st.floats(-0.5, 0.5)
OPTICS = st.builds(
    FocusOptics,
    rest_dioptre=st.floats(-0.3, 0.3),
    relay_magnification=st.floats(0.3, 4.0),
    incidence=st.floats(0.0, 1.0),
    pupil_offset=st.floats(-1.0, 1.0),
)


def free(length: float) -> np.ndarray:
    """Ray matrix of a path in air."""
    return np.array([[1.0, length], [0.0, 1.0]])


def power(dioptre: float) -> np.ndarray:
    """Ray matrix of a thin element."""
    return np.array([[1.0, 0.0], [-dioptre, 1.0]])


@given(st.floats(1.0, 1e4), st.floats(0.03, 0.5), st.floats(0.0, 0.2), st.floats(0.5, 3.0), st.floats(1e-4, 5e-3))
def test_the_ray_matrix_images_the_object_onto_the_sensor(
    distance: float, focal: float, mirror_distance: float, relay: float, extension: float
) -> None:
    """All rays of an object point meet on the sensor: element B of the matrix from object to sensor vanishes."""
    sensor = focal + extension * focal
    if mirror_distance * (1 / focal - 1 / sensor) > 0.5:
        return
    optics = FocusOptics(rest_dioptre_of_lens(focal, sensor, mirror_distance), relay)
    curvature = optics.curvature_for(dioptre_of(distance))
    relay_matrix = np.diag([relay, 1 / relay])
    path = (
        free(sensor) @ power(1 / focal) @ free(mirror_distance) @ power(2 * curvature) @ relay_matrix @ free(distance)
    )
    assert abs(path[0, 1]) < 1e-9 * np.abs(path).max() * max(distance, 1.0)


@given(OPTICS, DIOPTRES)
def test_dioptre_and_curvature_are_inverse(optics: FocusOptics, dioptre: float) -> None:
    assert optics.dioptre_for(optics.curvature_for(dioptre)) == pytest.approx(dioptre, abs=1e-12)


@given(OPTICS, DIOPTRES, st.floats(1e-4, 0.1))
def test_a_nearer_object_needs_a_more_concave_mirror(optics: FocusOptics, dioptre: float, step: float) -> None:
    assert optics.curvature_for(dioptre + step) > optics.curvature_for(dioptre)


def test_mirror_power_is_twice_the_curvature_and_a_relay_squares() -> None:
    assert FocusOptics().curvature_for(dioptre_of(10.0)) == pytest.approx(0.05)
    assert FocusOptics(relay_magnification=2.0).dioptre_for(0.05) == pytest.approx(0.4)


def test_the_mirror_is_flat_at_the_rest_distance() -> None:
    optics = FocusOptics.from_rest_distance(8.0, relay_magnification=1.7, incidence=0.3, pupil_offset=0.25)
    assert optics.curvature_for(dioptre_of(8.0)) == pytest.approx(0.0, abs=1e-15)
    assert distance_of(optics.dioptre_for(0.0)) == pytest.approx(8.0)


def test_oblique_incidence_has_the_mean_of_both_powers() -> None:
    angle = math.radians(45)
    tangential, sagittal = 2 * 0.05 / math.cos(angle), 2 * 0.05 * math.cos(angle)
    assert FocusOptics(incidence=angle).dioptre_for(0.05) == pytest.approx((tangential + sagittal) / 2)


def test_distances_count_from_the_reference_point() -> None:
    plain, offset = FocusOptics(), FocusOptics(pupil_offset=0.5)
    assert offset.curvature_for(dioptre_of(9.5)) == pytest.approx(plain.curvature_for(dioptre_of(10.0)))
    assert math.isnan(offset.dioptre_for(2.0)), "focused 0.25 m before the pupil: inside the camera"
    before, far = FocusOptics(relay_magnification=5.0, pupil_offset=-0.5), np.array([-0.05])
    assert before.dioptre_for(-0.05) == -before.distances_for(far)[0] == -math.inf, "beyond infinity, not too near"


def test_zero_and_infinity_both_mean_infinity() -> None:
    assert dioptre_of(0.0) == dioptre_of(math.inf) == 0.0
    assert distance_of(0.0) == distance_of(-0.1) == math.inf


@pytest.mark.parametrize("distance", [-1.0, math.nan])
def test_an_impossible_distance_is_named(distance: float) -> None:
    with pytest.raises(OpticsError, match=r"distance = .* m: must be above 0"):
        FocusOptics().curvature_for(dioptre_of(distance))


def test_an_object_inside_the_camera_is_refused() -> None:
    with pytest.raises(OpticsError, match="inside the camera"):
        FocusOptics(pupil_offset=-0.5).curvature_for(dioptre_of(0.4))


@pytest.mark.parametrize(
    ("field", "value"), [("relay_magnification", 0.0), ("incidence", 1.6), ("rest_dioptre", math.inf)]
)
def test_senseless_optics_are_refused(field: str, value: float) -> None:
    with pytest.raises(OpticsError, match=field):
        FocusOptics(**{field: value})


def test_a_lens_that_focuses_before_the_mirror_is_refused() -> None:
    with pytest.raises(OpticsError, match="between itself and the mirror"):
        rest_dioptre_of_lens(0.1, 0.2, mirror_distance=0.5)


@given(st.floats(1e-3, 0.1), st.floats(4e-7, 1e-6))
def test_depth_of_focus_is_a_quarter_wave_at_the_edge(radius: float, wavelength: float) -> None:
    sag = depth_of_focus(radius, wavelength) * radius**2 / 2
    assert 2 * sag == pytest.approx(wavelength / 4)


@given(optics=OPTICS, curvatures=st.lists(st.floats(-0.2, 0.2), max_size=5))
def test_many_distances_are_those_of_each_curvature(optics: FocusOptics, curvatures: list[float]) -> None:
    each = [distance_of(optics.dioptre_for(curvature)) for curvature in curvatures]
    np.testing.assert_allclose(optics.distances_for(np.array(curvatures)), each, rtol=1e-6)


def test_beyond_the_ends_of_the_focus_distances_are_infinite() -> None:
    distances = FocusOptics(0.1).distances_for(np.array([np.nan, -np.inf, np.inf, 0.0]))
    np.testing.assert_array_equal(distances, [np.nan, np.inf, -np.inf, 10.0])


def test_a_region_that_the_camera_reads_out_leaves_its_focal_length_binning_does_not() -> None:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    part = SimpleNamespace(x_offset=400, y_offset=300, width=320, height=240)
    info = SimpleNamespace(k=[50_000.0, 0.0, 0.0], binning_x=0, roi=part)
    assert focus_lens(values, 0.011, info).focal_length_px == 50_000
    info.binning_x = 2
    assert focus_lens(values, 0.011, info).focal_length_px == 25_000
    with pytest.raises(ValueError, match="came not yet"):
        focus_lens(values, 0.011, None)
