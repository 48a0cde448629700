"""Where a camera's axis meets the mirror, found by its own images: with the vertex held there the picture stands still.

A sphere of the curvature c has the slope c p at the distance p from its vertex, and the image of an infinitely distant
point is shifted by twice the mean slope over the part of the mirror that the camera uses. So if a camera looks beside
the middle of the calibrated aperture, its picture moves while the focus changes, by equal distances for equal changes.
Two small deliberate tilts show how far, and in which direction, the picture moves for a known tilt: pixel pitch, focal
length, relay and the camera's roll need not be known. Images are compared in pairs of equal blur: at opposite tilts in
the focus, and one step below and above the focus.

Shifts are found from the phase of the cross-power spectrum [34]. Only low spatial frequencies are used: their phase is
that of the mean slope, while that of higher ones is affected by aberrations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dm_common import Floats

#: Range of spatial frequencies used: lower limit in cycles over the image, upper limit in cycles per pixel.
LOWEST, HIGHEST = 1.5, 0.1
#: Tilt that is commanded to either side [m at the edge]: it moves the image by two diffraction widths.
TILT = 2.5e-7
#: Defocus to either side of the focus, in depths of focus: images are still sharp enough.
STEP = 4.0
#: Least ratio of a shift by tilt to its uncertainty; largest ratio of the shifts by equal tilts in two directions.
SIGNIFICANT, ANISOTROPY = 5.0, 2.0
#: Iterations of the fit of a phase that is known modulo 2 pi.
ROUNDS = 4


@dataclass(frozen=True)
class Boresight:
    """How the picture moves with the mirror; x to the right, y down.

    Attributes:
        scale: (2, 2) px per m of tilt in x and y (columns).
        drift: (2,) px per 1/m of curvature.
        drift_sigma: (2,) its standard deviation.
    """

    scale: Floats
    drift: Floats
    drift_sigma: Floats

    def offset(self, aperture_radius: float) -> Floats:
        """(2,) m: vector from the point where the vertex was held to the point where the axis meets the mirror."""
        return np.asarray(np.linalg.solve(self.scale, self.drift) / aperture_radius, dtype=float)


def image_shift(before: NDArray, after: NDArray) -> Floats:
    """(2,) px to the right and down by which the picture has moved between two images (H, W).

    Raises ValueError for a black image; numbers that are not finite count as black.
    """
    before, after = (np.nan_to_num(image.astype(float), posinf=0.0, neginf=0.0) for image in (before, after))
    if not (before.mean() > 0.0 and after.mean() > 0.0):
        raise ValueError("the image is black")
    window = np.outer(*(np.hanning(side + 2)[1:-1] for side in before.shape))
    first, second = (np.fft.rfft2((image / image.mean() - 1) * window) for image in (before, after))
    cross = second * first.conj()
    rows, columns = before.shape
    down, right = np.meshgrid(np.fft.fftfreq(rows), np.fft.rfftfreq(columns), indexing="ij")
    frequency = np.hypot(down, right)
    cross[(frequency < LOWEST / min(rows, columns)) | (frequency > HIGHEST)] = 0
    peak = np.unravel_index(np.fft.irfft2(cross, before.shape).argmax(), before.shape)
    shift = np.array([(place + side // 2) % side - side // 2 for place, side in zip(peak, before.shape, strict=True)])
    weight = np.sqrt(np.abs(cross)).ravel()
    slopes = -2 * np.pi * np.column_stack([down.ravel(), right.ravel()])
    for _round in range(ROUNDS):
        left = np.angle(cross.ravel() * np.exp(-1j * (slopes @ shift)))
        shift = shift + np.linalg.lstsq(slopes * weight[:, None], left * weight, rcond=None)[0]
    return shift[::-1]


def find_boresight(see: Callable[[float, Floats], NDArray], focus: float, step: float, pairs: int = 6) -> Boresight:
    """Measure how the picture moves with tilt and curvature.

    Args:
        see: takes an image (H, W) at a curvature [1/m] and a tilt (2,) of the mirror [m].
        focus: where the picture is sharp [1/m].
        step: to either side of it [1/m].
        pairs: number of images on either side, taken alternately.

    Raises:
        ValueError: the picture does not follow tilt.
    """

    def moved(curvature: float, tilt: Floats) -> tuple[Floats, Floats]:
        """Mean shift (2,) [px] from one side to the other, and its standard deviation."""
        images = [see(focus + sign * curvature, sign * tilt) for _pair in range(pairs) for sign in (-1, 1)]
        shifts = np.array([(-1) ** n * image_shift(*images[n : n + 2]) for n in range(len(images) - 1)])
        return shifts.mean(0), shifts.std(0) / np.sqrt(pairs)

    (by_x, sigma_x), (by_y, sigma_y) = (moved(0.0, TILT * direction) for direction in np.eye(2))
    scale = np.column_stack([by_x, by_y])
    strength = np.linalg.svd(scale, compute_uv=False)
    if not (strength[1] > SIGNIFICANT * max(sigma_x.max(), sigma_y.max()) and strength[0] < ANISOTROPY * strength[1]):
        raise ValueError(
            f"the picture does not follow the mirror's tilt: two equal tilts move it by {np.hypot(*by_x):.2f} and "
            f"{np.hypot(*by_y):.2f} px, with an uncertainty of {max(sigma_x.max(), sigma_y.max()):.2f} px; is "
            "hold_tilt of the focus controller off, does the calibration not know where the actuators are or come from "
            "maps whose tilt was removed, or is there nothing to see in the region?"
        )
    drift, sigma = moved(step, np.zeros(2))
    return Boresight(scale / (2 * TILT), drift / (2 * step), sigma / (2 * step))
