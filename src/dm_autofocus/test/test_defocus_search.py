"""Model of the blur, and the search from few images, on cameras that share no code with them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from defocused_camera import DEPTH, LENS, SIDE, DefocusedCamera, clouds

from dm_autofocus.search import defocus_search
from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.defocus_search import DepthFromDefocus
from dm_autofocus.search.focus_search import MOST_CHANGES, FocusSearch
from dm_autofocus.search.peak_search import Phase, SearchConfig
from dm_autofocus.sharpness import tenengrad

LOW, HIGH = -0.04, 0.04
CONFIG = SearchConfig(LOW, HIGH, DEPTH, coarse_points=11, approach=0.0)


@pytest.fixture(scope="module")
def model() -> DefocusModel:
    return DefocusModel((SIDE, SIDE), LENS, HIGH - LOW + 10 * DEPTH)


def run(search: FocusSearch, camera: DefocusedCamera, reach: float = math.inf) -> list[float]:
    """Feed a search to its end; returns where images were taken."""
    visited = []
    while not search.current.done:
        if abs(search.current.step.curvature) > reach:
            search.refuse()
            continue
        visited.append(search.current.step.curvature)
        if search.current.step.measured:
            image = camera.expose(visited[-1])
            search.feed(tenengrad(image), (image,))
        else:
            search.feed(None)
    return visited


@pytest.mark.parametrize("off", [0.0, 1.0, -3.0, 8.0, 20.0])
def test_power_falls_with_defocus_as_the_pupil_says(model: DefocusModel, off: float) -> None:
    """White texture: what is left of its power in each band, between an image in focus and one that is not."""
    white = 1 + 0.3 * np.random.default_rng(2).standard_normal((2 * SIDE, 2 * SIDE))
    camera = DefocusedCamera(white, 0.0, noise=0.0)
    sharp, dull = (model.powers(camera.expose(defocus)) for defocus in (0.0, off * DEPTH))
    expected = model.transfer(np.array([0.0, off * DEPTH]))[0]
    np.testing.assert_allclose(dull / sharp, expected[1] / expected[0], atol=0.05)


def test_noise_has_its_power_in_every_band_and_lamps_have_none(model: DefocusModel) -> None:
    noise = 100 * (1 + 0.02 * np.random.default_rng(3).standard_normal((SIDE, SIDE)))
    powers = model.powers(noise)
    assert np.average(powers, weights=model.modes) == pytest.approx(0.02**2, rel=0.05)
    lamp = 1 + 0.3 * np.linspace(-1, 1, SIDE)[:, None] - 0.2 * np.linspace(-1, 1, SIDE) ** 2
    np.testing.assert_allclose(model.powers(noise * lamp), powers, rtol=0.2)


def test_large_regions_are_tiled_and_small_ones_refused() -> None:
    wide = DefocusModel((300, 700), LENS, 0.01)
    image = 1 + 0.1 * np.random.default_rng(4).standard_normal((300, 700))
    assert np.average(wide.powers(image), weights=wide.modes) == pytest.approx(0.01, rel=0.05)
    with pytest.raises(ValueError, match="region = 20 x 100 px"):
        DefocusModel((100, 20), LENS, 0.01)


@pytest.mark.parametrize("place", [-0.0361, -0.0112, 0.0003, 0.0254])
@pytest.mark.parametrize("start", [-0.03, 0.02, math.nan])
def test_the_focus_is_found_in_few_images(model: DefocusModel, place: float, start: float) -> None:
    search = FocusSearch(CONFIG, model, start)
    visited = run(search, DefocusedCamera(clouds(), place))
    assert search.current.peak is not None and not search.current.peak.at_limit
    assert search.current.peak.curvature == pytest.approx(place, abs=DEPTH / 2)
    assert search.measured == len(visited) <= 12
    assert 0 < search.current.peak.error < DEPTH / 2
    assert (search.reason, search.current.phase) == ("", Phase.FINE)
    if start == 0.02:
        assert visited[0] > 0, "the nearer one first"


@pytest.mark.slow
@pytest.mark.parametrize("other", [-0.03, 0.0])
def test_what_stands_beside_the_region_at_another_distance_misleads_no_search(other: float) -> None:
    """Its blur reaches into the region in images far from the focus, and is sharpest where the object is not."""
    texture, inside = clouds(), np.zeros((2 * SIDE, 2 * SIDE))
    inside[SIDE // 2 : -SIDE // 2, SIDE // 2 : -SIDE // 2] = 1
    here, beside = DefocusedCamera(texture * inside, 0.02), DefocusedCamera(clouds(7, 0.4) * (1 - inside), other, 0.0)
    part = slice(SIDE // 2 - SIDE // 5, SIDE // 2 + SIDE // 5)
    search = FocusSearch(CONFIG, DefocusModel((SIDE // 5 * 2,) * 2, LENS, HIGH - LOW + 10 * DEPTH), -0.03)
    while not search.current.done:
        place = search.current.step.curvature
        image = (here.expose(place) + beside.expose(place))[part, part]
        search.feed(tenengrad(image), (image,))
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.02, abs=DEPTH / 2)
    assert search.reason == "" and search.measured <= 16


def test_the_powers_of_an_image_are_worked_out_once(model: DefocusModel, monkeypatch: pytest.MonkeyPatch) -> None:
    worked_out, powers = [], DefocusModel.powers

    def counted(self: DefocusModel, image: np.ndarray) -> np.ndarray:
        worked_out.append(image)
        return powers(self, image)

    monkeypatch.setattr(DefocusModel, "powers", counted)
    search = FocusSearch(CONFIG, model, 0.0)
    run(search, DefocusedCamera(clouds(), 0.0123))
    assert len(worked_out) == search.measured


@pytest.mark.parametrize("place", [LOW - 0.002, HIGH + 0.002])
def test_an_object_beyond_the_range_is_said_so(model: DefocusModel, place: float) -> None:
    search = FocusSearch(CONFIG, model, 0.0)
    run(search, DefocusedCamera(clouds(), place))
    assert search.current.peak is not None and search.current.peak.at_limit


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_nothing_to_see_ends_without_a_focus_and_without_a_sweep(model: DefocusModel, noise: float) -> None:
    search = FocusSearch(CONFIG, model, 0.0)
    visited = run(search, DefocusedCamera(np.ones((2 * SIDE, 2 * SIDE)), 0.0, noise))
    assert (search.current.peak, search.reason) == (None, "")
    assert np.diff(np.sort([LOW, *visited, HIGH])).max() <= 0.1001 * (HIGH - LOW)


@pytest.mark.slow
@pytest.mark.parametrize("points", [11, 14, 18])
def test_nothing_to_see_takes_no_more_images_than_a_sweep(model: DefocusModel, points: int) -> None:
    search = FocusSearch(replace(CONFIG, coarse_points=points), model, 0.0)
    visited = run(search, DefocusedCamera(np.ones((2 * SIDE, 2 * SIDE)), 0.0, 0.01))
    assert search.current.done and len(visited) <= points


@pytest.mark.slow
def test_what_is_seen_only_after_many_images_is_searched_and_not_swept(
    model: DefocusModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images count from where they change with focus; those that leave it open send no search away."""
    monkeypatch.setattr(defocus_search, "MOST_IMAGES", 6)
    search = FocusSearch(replace(CONFIG, coarse_points=18), model, 0.0)
    camera = DefocusedCamera(clouds(), 0.0)
    monkeypatch.setattr(defocus_search, "EVIDENCE", math.inf)
    for _image in range(10):
        image = camera.expose(search.current.step.curvature)
        search.feed(tenengrad(image), (image,))
    monkeypatch.setattr(defocus_search, "EVIDENCE", 25.0)
    run(search, camera)
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.0, abs=DEPTH / 2)
    assert search.reason == ""


def test_what_the_mirror_refuses_is_left_out(model: DefocusModel) -> None:
    search = FocusSearch(CONFIG, model, 0.0)
    run(search, DefocusedCamera(clouds(), 0.01), reach=0.017)
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.01, abs=DEPTH / 2)
    assert search.current.config.low > -0.021 and search.current.config.high < 0.021


@pytest.mark.parametrize("fed", [0, 3])
def test_a_mirror_that_refuses_all_ends_a_search_with_that_reason(model: DefocusModel, fed: int) -> None:
    search, camera = FocusSearch(CONFIG, model, 0.0), DefocusedCamera(clouds(), 0.01)
    for _image in range(fed):
        search.feed(1.0, (camera.expose(search.current.step.curvature),))
    with pytest.raises(ValueError, match="range = "):
        while True:
            search.refuse()


def test_an_image_that_the_range_was_drawn_in_past_is_no_top(model: DefocusModel) -> None:
    """What the mirror took at first it may refuse later: its reach depends on its history."""
    search, camera = FocusSearch(CONFIG, model, 0.0), DefocusedCamera(clouds(), -0.0185)
    for _image in range(2):
        image = camera.expose(search.current.step.curvature)
        search.feed(tenengrad(image), (image,))
    run(search, camera, reach=0.012)
    assert search.current.peak is not None and search.current.peak.at_limit and search.current.peak.curvature > -0.013


@pytest.mark.parametrize("off", [-7, 7])
def test_a_place_at_the_end_of_what_is_thought_of_is_not_believed(model: DefocusModel, off: int) -> None:
    """Noise and what else is in the picture may make an image the sharpest that is far from the focus."""
    camera = DefocusedCamera(clouds(), 0.01 + off * DEPTH)
    search = DepthFromDefocus(CONFIG, model, 0.0)
    while not search.done:
        place = search.step.curvature
        search.feed(math.exp(-(((place - 0.01) / (8 * DEPTH)) ** 2)), model.powers(camera.expose(place)))
    assert search.peak is not None and search.peak.curvature == pytest.approx(0.01 + off * DEPTH, abs=0.5 * DEPTH)


def test_where_the_optics_do_not_explain_the_images_the_range_is_swept(
    model: DefocusModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So it is where no focus was found after so many images."""
    monkeypatch.setattr(defocus_search, "MOST_IMAGES", 3)
    search = FocusSearch(CONFIG, model, 0.0)
    camera = DefocusedCamera(clouds(), 0.012)
    while not search.current.done and not search.reason:
        image = camera.expose(search.current.step.curvature)
        search.feed(tenengrad(image), (image,))
    assert "do not explain" in search.reason and search.measured == 3
    before = search.measured
    visited = run(search, DefocusedCamera(clouds(), 0.012))
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.012, abs=DEPTH)
    assert search.measured == before + len(visited) <= search.steps


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_optics_that_contradict_the_images_are_named_with_what_would_fit(share: float) -> None:
    """Who gives half the focal length hears that twice as much would fit; who gives the right one hears nothing."""
    lens = replace(LENS, focal_length_px=share * LENS.focal_length_px)
    search = FocusSearch(CONFIG, DefocusModel((SIDE, SIDE), lens, HIGH - LOW + 10 * DEPTH), 0.0)
    run(search, DefocusedCamera(clouds(), 0.0123))
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.0123, abs=DEPTH)
    assert search.fitting_scale() == pytest.approx(1 / share)
    assert FocusSearch(CONFIG, "not known", 0.0).fitting_scale() == 1


def test_things_at_several_distances_that_the_optics_do_not_explain_are_swept(
    model: DefocusModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(defocus_search, "EVIDENCE", math.inf)
    search = FocusSearch(CONFIG, model, 0.0)
    run(search, DefocusedCamera(clouds(), 0.0123))
    assert "do not explain" in search.reason
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.0123, abs=DEPTH)


@pytest.mark.parametrize("before", [0, 1])
def test_images_of_another_size_are_swept(model: DefocusModel, before: int) -> None:
    search = FocusSearch(CONFIG, model, LOW)
    for _image in range(before):
        search.feed(5.0, (DefocusedCamera(clouds(), 0.0123).expose(LOW),))
    search.feed(1.0, (np.ones((10, 10)),))
    assert "size" in search.reason
    while not search.current.done:
        off = search.current.step.curvature - 0.0123
        search.feed(1 / (1 + (off / 0.01) ** 2), (np.ones((10, 10)),))
    assert search.current.peak is not None and search.fitting_scale() == 1
    assert search.current.peak.sharpness <= 1, "of these images, not of those before"


def test_without_optics_or_a_mirror_to_trust_every_sweep_begins_below(model: DefocusModel) -> None:
    assert FocusSearch(CONFIG, "the focal length is not known", 0.0).reason == "the focal length is not known"
    search = FocusSearch(CONFIG, model, 0.0)
    search.sweep("the mirror's hysteresis is not known", math.inf)
    camera = DefocusedCamera(clouds(), 0.01)
    visited = run(search, camera)
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.01, abs=DEPTH)
    assert visited.count(LOW) >= 3
    # In the units of the images: tracking compares the next ones with it.
    assert search.current.peak.sharpness == pytest.approx(tenengrad(camera.expose(0.01)), rel=0.1)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("changes", [[4], [3, 9], [5, 6, 14, 15]])
def test_images_of_two_sizes_are_not_compared(model: DefocusModel, known: bool, changes: list[int]) -> None:
    """Of another size they may be four times as sharp. The camera itself may change it, or its driver."""
    config = replace(CONFIG, approach=0.0)
    search, camera = FocusSearch(config, model if known else "no lens", 0.0), DefocusedCamera(clouds(), 0.01)

    def feed_all() -> None:
        for number in range(1000):
            image, half = camera.expose(search.current.step.curvature), sum(number >= change for change in changes) % 2
            search.feed((1 + 9 * half) * tenengrad(image), (image[::2] if half else image,))
            if search.current.done:
                break

    if len(changes) > MOST_CHANGES:
        with pytest.raises(ValueError, match="again and again"):
            feed_all()
        return
    feed_all()
    assert search.reason == "the images changed their size"
    assert search.current.peak is not None and search.current.peak.curvature == pytest.approx(0.01, abs=DEPTH)
