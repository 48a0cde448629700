"""Sharpness: falls with blur, ignores brightness, looks only at its region."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter

from dm_autofocus.images import decompressed, exposure_fault, grey
from dm_autofocus.sharpness import METRICS, WHOLE, check_region, cut, local_tenengrad, region_of, tenengrad


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


@given(st.data())
def test_a_region_in_pixels_is_these_pixels(data: st.DataObject) -> None:
    """In the image, and refused beyond it; all zeros are the whole image, as in ROS."""
    sides, offsets, sizes = [], [], []
    for _axis in range(2):
        sides.append(data.draw(st.integers(3, 4000)))
        offsets.append(data.draw(st.integers(0, sides[-1] - 3)))
        sizes.append(data.draw(st.integers(3, sides[-1] - offsets[-1])))
    roi = SimpleNamespace(x_offset=offsets[1], y_offset=offsets[0], width=sizes[1], height=sizes[0])
    region = check_region(region_of(roi, sides[1], sides[0]))
    for axis, numbers in enumerate(np.ogrid[: sides[0], : sides[1]]):
        part = cut(np.broadcast_to(numbers, sides), region)
        assert (part.shape, part[0, 0]) == (tuple(sizes), offsets[axis])
    with pytest.raises(ValueError, match=f"height = {offsets[1]}, .* image of {offsets[1] + sizes[1] - 1} x "):
        region_of(roi, offsets[1] + sizes[1] - 1, sides[0])
    assert region_of(SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0), 640, 480) == WHOLE


def test_missing_values_do_not_spoil_the_figure() -> None:
    image = texture().astype(np.float32)
    image[3, 5] = np.nan
    assert np.isfinite(tenengrad(image))


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**100])
def test_numbers_of_any_size_have_a_sharpness(scale: float) -> None:
    """Their squares are beyond what float32 can hold."""
    image = texture().astype(np.float32)
    for figure in METRICS.values():
        assert figure(image * np.float32(scale)) == pytest.approx(figure(image))
    assert local_tenengrad(image * np.float32(scale), 8) == pytest.approx(local_tenengrad(image, 8))


@pytest.mark.parametrize("offset", [-0.5, -0.49, -2.0])
def test_grey_levels_that_cancel_are_refused(offset: float) -> None:
    image = (texture() / 255.0).astype(np.float32)
    image -= image.mean() - 0.5
    for figure in (*METRICS.values(), lambda one: local_tenengrad(one, 8)):
        assert np.isfinite(np.asarray(figure(image - np.float32(0.2)))).all()
        with pytest.raises(ValueError, match="negative grey levels cancel the positive ones"):
            figure(image + np.float32(offset))


def message(pixels: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> SimpleNamespace:
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(height, -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding))).tobytes()
    step = rows.shape[1] + padding
    return SimpleNamespace(height=height, width=width, encoding=encoding, is_bigendian=big, step=step, data=data)


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("encoding", "kind", "channels", "taken"),
    [
        ("mono8", "u1", 1, 0),
        ("16UC1", "u2", 1, 0),
        ("32FC1", "f4", 1, 0),
        ("rgb8", "u1", 3, 1),
        ("bgr8", "u1", 3, 1),
        ("bgra8", "u1", 4, 1),
        ("rgb16", "u2", 3, 1),
        ("yuv422", "u1", 2, 1),
        ("uyvy", "u1", 2, 1),
        ("yuyv", "u1", 2, 0),
        ("yuv422_yuy2", "u1", 2, 0),
    ],
)
def test_every_encoding_gives_its_grey_levels(
    encoding: str, kind: str, channels: int, taken: int, padding: int, big: bool
) -> None:
    pixels = np.random.default_rng(1).integers(0, 250, (5, 7, channels)).astype(kind)
    levels = grey(message(pixels, encoding, padding, big))
    np.testing.assert_array_equal(levels, pixels[..., taken])
    assert levels.dtype.isnative


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_of_a_bayer_pattern_the_green_pixels_count(pattern: str, bits: int) -> None:
    """Of an odd last row and column there are no four pixels."""
    mosaic = np.random.default_rng(2).integers(200, 256, (7, 9)).astype(f"u{bits // 8}")
    wanted = np.zeros((3, 4))
    for place, colour in enumerate(pattern):
        if colour == "g":
            wanted += mosaic[place // 2 : 6 : 2, place % 2 : 8 : 2]
    np.testing.assert_array_equal(grey(message(mosaic, f"bayer_{pattern}{bits}", padding=3)), wanted)


@pytest.mark.parametrize(
    ("kind", "file", "image_format", "encoding"),
    [
        ("u1", "PNG", "mono8; png compressed ", "mono8"),
        ("u2", "PNG", "mono16; png compressed ", "mono16"),
        ("i4", "TIFF", "mono16; tiff compressed ", "mono16"),  # decoded as a PNG of 16 bits is by older Pillow
        (">u2", "TIFF", "mono16; tiff compressed ", "mono16"),
        ("f4", "TIFF", "32FC1; tiff compressed ", "32FC1"),
        ("u1", "JPEG", "jpeg", "mono8"),
        ("u1", "PNG", "bayer_grbg8; png compressed", "bayer_grbg8"),
        ("3u1", "JPEG", "bgr8; jpeg compressed bgr8", "rgb8"),
        ("4u1", "PNG", "png", "rgba8"),
    ],
)
def test_compressed_images_give_their_pixels(kind: str, file: str, image_format: str, encoding: str) -> None:
    smooth = np.add.outer(np.arange(16), np.arange(24)) * (3 if "8" in encoding else 1000)
    colours = kind[0].isdigit()
    pixels = np.broadcast_to(smooth[..., None], (16, 24, int(kind[0]))) if colours else smooth
    written = io.BytesIO()
    Image.fromarray(pixels.astype(kind[colours:])).save(written, file)
    read, name = decompressed(written.getvalue(), image_format)
    assert name == encoding and read.shape == pixels.shape
    assert read.dtype == {"mono16": np.uint16, "32FC1": np.float32}.get(encoding, np.uint8)
    np.testing.assert_allclose(read, pixels, atol=4 if file == "JPEG" else 0)
    if file == "PNG":
        with pytest.raises(ValueError, match="cannot be decoded"):
            decompressed(written.getvalue()[:45], image_format)
        for broken in (b"", b"nothing", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n"):
            with pytest.raises(ValueError, match=r"is not JPEG, PNG or TIFF$"):
                decompressed(broken, image_format)


@pytest.mark.parametrize("encoding", ["nv12", "64FC1", "jpeg", ""])
def test_an_unknown_encoding_is_named(encoding: str) -> None:
    with pytest.raises(ValueError, match=f"'{encoding}': must be one of mono8"):
        grey(message(np.zeros((4, 4), "u1"), encoding))


def test_wrong_exposures_are_named() -> None:
    clipped = np.minimum(2 * texture(), 255).astype("u1")
    assert exposure_fault(np.zeros((4, 4), "u1")) == exposure_fault(np.full((4, 4), np.nan)) == "the image is black"
    noise = np.zeros((40, 50), "u1")
    noise[::4, ::5], noise[7, 7] = 1, 200  # read noise that rarely reaches the first grey level, and a hot pixel
    assert exposure_fault(noise).startswith("the image is almost black: ")
    noise[10:12, 10:12] = 200  # a star is no fault
    assert exposure_fault(noise) == ""
    assert "have the largest value, 1" in exposure_fault(np.array([[np.nan, 1.0, 1.0, 0.0]]))
    assert "have the largest value, 255" in exposure_fault(clipped + (255 - clipped) * (clipped > 180))
    assert exposure_fault(texture().astype("u1")) == exposure_fault(texture().astype("f4")) == ""
    assert exposure_fault(texture() / 255) == ""


def test_the_sharpness_of_cells_is_that_of_what_is_around_them() -> None:
    image = texture(shape=(50, 61))
    cells = local_tenengrad(image, 10)
    assert cells.shape == (5, 7)
    around = tenengrad(image[9:41, 19:51]) * image[10:40, 19:51].mean() ** 2 / image.mean() ** 2
    assert cells[2, 3] == pytest.approx(around, rel=0.03)
    assert not local_tenengrad(np.full((50, 61), 7.0), 10).any()
    assert not local_tenengrad(np.zeros((50, 61), "u1"), 10).any()


def test_a_cut_image_is_refused() -> None:
    cut_off = message(np.zeros((4, 4), "u1"), "mono8")
    cut_off.data = cut_off.data[:-3]
    with pytest.raises(ValueError, match="13 bytes"):
        grey(cut_off)
