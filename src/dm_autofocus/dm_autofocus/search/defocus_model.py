"""How defocus changes the power of an image at each spatial frequency, computed from the optics alone.

At the curvature c, an object that is in focus at the curvature b has the power S(u) T(u, c - b) + N at the spatial
frequency u: S is the power of the object's texture, T the squared modulation transfer of a circular pupil that is out
of focus, N that of white noise. The pixels, and whatever else does not change with the focus, multiply S and need not
be known. The transfer of a pupil of radius a with w waves of defocus at its edge is the autocorrelation of the pupil
([31]; Goodman, Introduction to Fourier Optics, section 6.4)

    H(s, w) = 4/pi int_0^(1 - s/2) sqrt(1 - (x + s/2)^2) cos(4 pi w s x) dx,     s = u lambda f / a < 2,

with the frequency u in cycles per pixel, f the focal length in pixels and w = (c - b) a^2 / lambda.
"""

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.optics import depth_of_focus
from dm_common import Floats

#: Largest and smallest side of the tiles in which power is measured [px], and most tiles along a side.
TILE_MAX, TILE_MIN, TILES = 256, 24, 3
#: Most bands, and the lowest frequency in cycles per side of a tile; the highest is half a cycle per pixel.
BANDS, LOWEST = 20, 2.5
#: Samples of the transfer per band, nodes of its integral, and step of its table in depths of focus.
SAMPLES, NODES, STEP = 5, 96, 0.25
#: The transfer of a real pupil may reach the largest ideal one among defocuses that differ by up to this share.
SPREAD = 0.17

#: Relative error of the transfer; of the noise, between images; share of power that leaks in from lower bands.
TRANSFER_ERROR, NOISE_ERROR, LEAKAGE = 0.25, 0.05, 0.002
#: Relative error of the transfer between images that are nearly alike, on either side of the focus.
TRANSFER_ERROR_NEAR = 0.1
#: Largest ratio between the noise of images, as their brightness flickers.
NOISE_RATIO = 1.1
#: Negligible power (squared), which keeps variances above zero.
TINY = 1e-18
#: Factors on the focal length that are tried.
SCALES = (0.125, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
#: Largest distance from the focus of images that are used, in steps of the table.
FITTED = 48.0
#: By how much another focal length must lower the misfit to be reported (twice a log-likelihood ratio).
BETTER = 60.0


@dataclass(frozen=True)
class FocusLens:
    """Data of a camera that determine how defocus looks in it.

    Attributes:
        aperture_radius: of the beam on the mirror [m].
        wavelength: mean, of the images [m].
        focal_length_px: of lens and relay as seen from the mirror, in pixels.
    """

    aperture_radius: float
    wavelength: float
    focal_length_px: float


class DefocusModel:
    """Powers of images in bands of spatial frequency, and the share of them that passes a defocused pupil.

    Args:
        shape: rows and columns of the images that are given to `powers`.
        lens: of the camera.
        reach: largest defocus that is needed, as a difference of curvatures [1/m].

    Attributes:
        shape: as given.
        modes: number of independent values that are averaged in the power of each band, (K,).

    Raises:
        ValueError: the images are too small.
    """

    def __init__(self, shape: tuple[int, int], lens: FocusLens, reach: float) -> None:
        if min(shape) < TILE_MIN:
            raise ValueError(
                f"region = {shape[1]} x {shape[0]} px: at least {TILE_MIN} x {TILE_MIN} show how defocused they are"
            )
        self.shape = shape
        rows, columns = (min(side, TILE_MAX) for side in shape)
        self._starts = [
            (int(top), int(left))
            for top in np.linspace(0, shape[0] - rows, min(math.ceil(shape[0] / rows), TILES))
            for left in np.linspace(0, shape[1] - columns, min(math.ceil(shape[1] / columns), TILES))
        ]
        window = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1])
        self._window = window / math.sqrt(np.vdot(window, window))
        self._smooth = [np.linalg.qr(np.vander(np.linspace(-1, 1, side), 3))[0] for side in (rows, columns)]
        self._edges = edges = _band_edges(min(rows, columns))
        frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None])
        band = np.digitize(frequency, edges) - 1
        self._inside = (band >= 0) & (band < len(edges) - 1)
        self._band = band[self._inside]
        # Frequencies in the first column occur twice, with their negatives.
        self._share = np.where(np.arange(frequency.shape[1]) == 0, 0.5, 1.0)[None].repeat(rows, 0)[self._inside]
        self._count = np.bincount(self._band, self._share, len(edges) - 1)
        self._gradient = self._count * np.sin(np.pi * (edges[:-1] + edges[1:])) ** 2
        # The window correlates neighbouring values: by a factor of 1.5 along each side.
        self.modes = self._count * len(self._starts) / 2.25
        self._step = STEP * depth_of_focus(lens.aperture_radius, lens.wavelength)
        self._set_lens(lens, math.ceil(reach / self._step) + 2)

    def _set_lens(self, lens: FocusLens, length: int) -> None:
        self._lens = lens
        self._transfer = _transfer_table(self._edges, lens, length)
        self._envelope = _envelope(self._transfer)

    def fitting_scale(self, focus: float, places: Floats, powers: Floats) -> float:
        """Factor on the focal length with which the optics explain the images best; 1 = the given one explains them.

        Between 0.35 and 2 it is 1: aberrations that blur an image at every focus look like a shorter focal length, and
        errors of that size cost images, not accuracy. It is also 1 if fewer than two images are near the focus.

        Args:
            focus: where the object is [1/m].
            places: where the images were taken [1/m], (I,).
            powers: of the images, (I, K).
        """
        near = np.abs(places - focus) < FITTED * self._step
        if near.sum() < 2:  # only ratios between images count
            return 1.0
        grid = np.linspace(focus - 4 * self._step, focus + 4 * self._step, 9)
        other, misfits = copy(self), {}
        for scale in SCALES:
            lens = replace(self._lens, focal_length_px=scale * self._lens.focal_length_px)
            other._set_lens(lens, int(FITTED) + 8)
            misfits[scale] = other.judge(grid, places[near], powers[near], TRANSFER_ERROR)[0].min()
        best = min(misfits, key=misfits.__getitem__)
        named = (best <= 0.35 or best >= 2) and misfits[best] < misfits[1.0] - BETTER
        return best if named else 1.0

    def powers(self, image: NDArray) -> Floats:
        """Mean power in each band, (K,), of an image of the model's shape, relative to its brightness squared.

        Illumination that varies slowly over a tile is divided out. White noise of the relative standard deviation s
        has the power s^2 in every band.
        """
        rows, columns = self._window.shape
        total = np.zeros(len(self._count))
        across, along = self._smooth
        for top, left in self._starts:
            tile = np.nan_to_num(image[top : top + rows, left : left + columns].astype(float), posinf=0.0, neginf=0.0)
            mean = tile.mean()
            if mean <= 0:
                continue
            brightness = np.maximum(across @ (across.T @ tile @ along) @ along.T, 0.2 * mean)
            spectrum = np.fft.rfft2((tile / brightness - 1) * self._window)
            power = (spectrum.real**2 + spectrum.imag**2)[self._inside]
            total += np.bincount(self._band, power * self._share, len(total))
        return total / (self._count * len(self._starts))

    def sharpness(self, powers: Floats) -> float:
        """Power of the image's gradient from its powers (K,).

        As with the Sobel gradient, but the outer parts of a tile have less weight, and so has what blurs in from
        outside the region.
        """
        return float(self._gradient @ powers)

    def transfer(self, defocus: Floats) -> tuple[Floats, Floats]:
        """Shares of the power that pass, and the largest that these may be for a pupil that is not ideal, (..., K).

        `defocus` is the difference of curvatures [1/m], (...).
        """
        place = np.minimum(np.abs(defocus) / self._step, len(self._transfer) - 1.001)
        first = place.astype(int)
        rest = (place - first)[..., None]
        transfer, envelope = (
            table[first] * (1 - rest) + table[first + 1] * rest for table in (self._transfer, self._envelope)
        )
        return transfer, envelope

    def judge(
        self, grid: Floats, places: Floats, powers: Floats, error: float, stray: float = 0.0
    ) -> tuple[Floats, float]:
        """How well each place of the object explains the images.

        Args:
            grid: candidate places of the object [1/m], (G,).
            places: where the images were taken [1/m], (I,).
            powers: of the images, (I, K).
            error: relative error of the transfer.
            stray: power that blurs in from outside the region, as a share of the least power of an image in a band.

        Returns:
            The misfit of each place of the grid, (G,): twice the negative logarithm of its likelihood; and by how much
            the misfit of the best place is smaller than that of a scene that does not change with focus.
        """
        lowest = powers[:, -3:].min(1)
        noise = np.minimum(lowest, NOISE_RATIO * lowest.min())[:, None]
        signal = powers - noise
        leaked = np.maximum.accumulate(np.maximum(signal, 0), axis=1)
        leaked = LEAKAGE * np.pad(leaked, ((0, 0), (1, 0)))[:, :-1]
        blurred_in = stray * np.maximum(signal, 0).min(0)
        floor = blurred_in**2 + noise**2 * (1 / self.modes + NOISE_ERROR**2) + leaked**2 + TINY
        shares, envelopes = self.transfer(grid[:, None] - places)
        misfit = self._misfit(signal, noise, floor, shares, envelopes, error)
        flat = np.ones((1, *powers.shape))
        return misfit, float(self._misfit(signal, noise, floor, flat, flat, error)[0] - misfit.min())

    def _misfit(
        self, signal: Floats, noise: Floats, floor: Floats, shares: Floats, envelopes: Floats, error: float
    ) -> Floats:
        """Twice the negative log likelihood (G,) of the signals (I, K) if shares (G, I, K) of the texture pass.

        The texture's power in each band is fitted. Its variance depends on it, so a few iterations are made.
        """
        modes = self.modes
        guess = np.maximum(signal, 0)
        variance = floor + 2 * noise * guess / modes + (error * guess) ** 2
        for _round in range(4):
            weight = shares / variance
            texture = np.sum(weight * signal, 1) / np.maximum(np.sum(weight * shares, 1), 1e-300)
            texture = np.maximum(texture, 0)[:, None]
            expected = texture * shares
            variance = floor + (2 * noise + expected) * expected / modes + (error * texture * envelopes) ** 2
        return np.sum((signal - expected) ** 2 / variance + np.log(variance), axis=(1, 2))


def _band_edges(side: int) -> Floats:
    """Edges of the bands [cycles per px], rising in equal ratios, but not closer than a tile can resolve."""
    edges = [LOWEST / side]
    ratio = (0.5 / edges[0]) ** (1 / BANDS)
    while edges[-1] < 0.5:
        edges.append(max(edges[-1] * ratio, edges[-1] + 1 / side))
    edges[-1] = 0.5
    if edges[-1] < 1.05 * edges[-2]:
        edges.pop(-2)
    return np.array(edges)


def _transfer_table(edges: Floats, lens: FocusLens, length: int) -> Floats:
    """Squared transfer at multiples of STEP depths of focus, (length, K), mean over each band's frequencies."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    frequency = edges[:-1, None] + np.diff(edges)[:, None] * share
    shift = frequency * lens.focal_length_px * lens.wavelength / lens.aperture_radius
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    half = np.maximum(1 - shift / 2, 0)[..., None]
    x = (nodes + 1) / 2 * half
    chord = weights / 2 * half * np.sqrt(np.maximum(1 - (x + shift[..., None] / 2) ** 2, 0))
    phase = np.pi * STEP * shift[..., None] * x  # of one step: a depth of focus is a quarter wave
    amplitude = [4 / np.pi * np.sum(chord * np.cos(number * phase), axis=-1) for number in range(length)]
    return np.asarray(np.sum(np.square(amplitude) * frequency, axis=2) / frequency.sum(1))


def _envelope(table: Floats) -> Floats:
    """Largest value around each place of a table, (length, K)."""
    place = np.arange(len(table))
    low = np.maximum(np.floor(place * (1 - SPREAD)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(place * (1 + SPREAD)).astype(int) + 2, len(table) - 1)
    return np.maximum([table[a : b + 1].max(0) for a, b in zip(low, high, strict=True)], 1e-5)
