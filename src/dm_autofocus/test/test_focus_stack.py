"""A stack of images: two planes are told apart, the image is sharp on both, and what shows nothing has no place."""

from __future__ import annotations

import numpy as np
import pytest
from defocused_camera import DEPTH, SIDE, DefocusedCamera, clouds

from dm_autofocus.focus_stack import ImageStack

#: Where the left and the right half are sharp, and where the images are taken [1/m].
LEFT, RIGHT = -0.0123, 0.0077
PLACES = np.linspace(-20, 20, 11) * DEPTH


def halves(curvature: float, left: np.ndarray, right: np.ndarray, noise: float = 0.01) -> np.ndarray:
    cameras = DefocusedCamera(left, LEFT, noise), DefocusedCamera(right, RIGHT, noise)
    parts = [camera.expose(curvature) for camera in cameras]
    return np.hstack([parts[0][:, : SIDE // 2], parts[1][:, SIDE // 2 :]])


@pytest.fixture(scope="module")
def stack() -> ImageStack:
    taken = ImageStack(cell=4)
    for place in PLACES:
        image = halves(place, clouds(1), clouds(2))
        taken.add(place, image, image[..., None])
    return taken


def test_the_two_planes_are_told_apart(stack: ImageStack) -> None:
    places = stack.in_focus(0.05)
    assert places.shape == (SIDE // 4, SIDE // 4)
    for truth, columns in ((LEFT, np.s_[2:13]), (RIGHT, np.s_[19:30])):
        seen = places[2:30, columns]
        assert np.isfinite(seen).mean() > 0.98
        assert np.nanmedian(np.abs(seen - truth)) < 0.5 * DEPTH


def test_the_image_is_sharp_on_both(stack: ImageStack) -> None:
    left, right = (halves(place, clouds(1), clouds(2)) for place in (LEFT, RIGHT))
    sharp = np.hstack([left[:, : SIDE // 2], right[:, SIDE // 2 :]])
    inner = np.r_[10:54, 74:118]
    off = (stack.image[..., 0] - sharp)[10:118, inner]
    dull = (left - sharp)[10:118, inner]
    assert off.std() < 0.3 * dull.std()


@pytest.mark.slow
def test_what_shows_nothing_has_no_place() -> None:
    blank = np.ones_like(clouds())
    for count in (5, 11, 30):
        stack = ImageStack(cell=4)
        for number in range(count):
            rng = np.random.default_rng(number)
            image = halves(0.0, blank, blank, 0.0) + rng.standard_normal((SIDE, SIDE))
            stack.add(0.001 * number, image, image)
        assert np.isnan(stack.in_focus(0.05)).mean() > 0.999


def test_a_focus_beyond_the_stack_is_beyond_it() -> None:
    stack = ImageStack(cell=4)
    for place in np.linspace(LEFT + 4 * DEPTH, RIGHT - 4 * DEPTH, 9):
        image = halves(place, clouds(1), clouds(2))
        stack.add(place, image, image)
    places = stack.in_focus(0.05)
    for end, columns in ((-np.inf, np.s_[2:13]), (np.inf, np.s_[19:30])):
        seen = places[2:30, columns][~np.isnan(places[2:30, columns])]
        assert seen.size > 50 and np.all(seen == end)


def test_a_bayer_image_has_cells_of_twice_the_pixels() -> None:
    stack = ImageStack(cell=4)
    stack.add(0.0, np.zeros((15, 10)), np.zeros((31, 20, 1)))
    assert stack.enlarge(np.arange(12).reshape(4, 3)).shape == (31, 20)


def test_pixels_that_share_their_colours_come_from_one_image() -> None:
    """Of YUV 4:2:2, one of two neighbours has U, the other V."""
    stack, rng = ImageStack(cell=3), np.random.default_rng(1)
    for number in range(5):
        stack.add(0.0, rng.random((12, 12)), np.full((12, 12, 2), number))
    assert len(np.unique(stack.image)) > 1
    np.testing.assert_array_equal(stack.image[:, 0::2], stack.image[:, 1::2])


def test_too_few_images_and_other_sizes_are_refused() -> None:
    stack = ImageStack(cell=4)
    stack.add(0.0, np.zeros((8, 8)), np.zeros((8, 8)))
    with pytest.raises(ValueError, match="needs at least 5"):
        stack.in_focus(0.05)
    with pytest.raises(ValueError, match="size"):
        stack.add(0.1, np.zeros((8, 12)), np.zeros((8, 12)))
