"""Sharpness: falls with blur, ignores brightness, looks only at its region."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from dm_autofocus.images import ImageError, grey
from dm_autofocus.sharpness import METRICS, check_region, cut, tenengrad


def texture(seed: int = 0, shape: tuple[int, int] = (64, 80)) -> np.ndarray:
    return 100 + 30 * np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("metric", METRICS)
@given(seed=st.integers(0, 2**31), blur=st.floats(0.5, 5.0), more=st.floats(0.3, 3.0))
def test_more_blur_is_less_sharp(metric: str, seed: int, blur: float, more: float) -> None:
    image = texture(seed)
    sharp, dull = (METRICS[metric](gaussian_filter(image, sigma, mode="wrap")) for sigma in (blur, blur + more))
    assert sharp > dull


@pytest.mark.parametrize("metric", METRICS)
@given(gain=st.floats(0.01, 100.0))
def test_brightness_drops_out(metric: str, gain: float) -> None:
    image = texture()
    assert METRICS[metric](gain * image) == pytest.approx(METRICS[metric](image), rel=1e-3)


def test_known_gradient() -> None:
    """A ramp of slope 1 per px has the Sobel gradient 8."""
    ramp = np.tile(np.arange(1.0, 12.0), (9, 1))
    assert tenengrad(ramp) == pytest.approx(64 / ramp.mean() ** 2, rel=1e-6)


def test_thinned_rows_give_the_same_figure() -> None:
    image = texture(shape=(600, 400))
    assert tenengrad(image, pixel_budget=40_000) == pytest.approx(tenengrad(image), rel=0.02)


def test_only_the_region_counts() -> None:
    image = np.full((60, 60), 100.0)
    image[:30] = texture(shape=(30, 60))
    assert tenengrad(cut(image, (0.0, 0.55, 1.0, 0.45))) == 0.0
    assert tenengrad(cut(image, (0.0, 0.0, 1.0, 0.5))) > 0.0


@pytest.mark.parametrize("region", [(0.5, 0.0, 0.6, 1.0), (0.0, 0.0, 0.0, 1.0), (-0.1, 0.0, 0.5, 0.5), (0.0, 0.0, 1.0)])
def test_a_region_outside_the_image_is_refused(region: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="region"):
        check_region(region)


def test_a_region_of_a_pixel_is_refused() -> None:
    with pytest.raises(ValueError, match="px of an image"):
        cut(texture(), (0.0, 0.0, 0.01, 0.01))


def test_missing_values_do_not_spoil_the_figure() -> None:
    image = texture().astype(np.float32)
    image[3, 5] = np.nan
    assert np.isfinite(tenengrad(image))


def message(pixels: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> SimpleNamespace:
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(height, -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding))).tobytes()
    step = rows.shape[1] + padding
    return SimpleNamespace(height=height, width=width, encoding=encoding, is_bigendian=big, step=step, data=data)


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("encoding", "kind", "channels"),
    [("mono8", "u1", 1), ("16UC1", "u2", 1), ("32FC1", "f4", 1), ("rgb8", "u1", 3), ("bgr8", "u1", 3)],
)
def test_every_encoding_gives_its_grey_levels(encoding: str, kind: str, channels: int, padding: int, big: bool) -> None:
    shape = (5, 7) if channels == 1 else (5, 7, channels)
    pixels = np.random.default_rng(1).integers(0, 250, shape).astype(kind)
    wanted = pixels if channels == 1 else pixels[..., 1]
    np.testing.assert_array_equal(grey(message(pixels, encoding, padding, big)), wanted)


def test_an_unknown_encoding_is_named() -> None:
    with pytest.raises(ImageError, match="'yuv422': must be one of mono8"):
        grey(message(np.zeros((4, 4), "u1"), "yuv422"))


def test_a_cut_image_is_refused() -> None:
    cut_off = message(np.zeros((4, 4), "u1"), "mono8")
    cut_off.data = cut_off.data[:-3]
    with pytest.raises(ImageError, match="13 bytes"):
        grey(cut_off)
