"""A camera behind an ideal mirror for the tests of the search: FFT of the pupil, twice as fine as the pixels."""

from __future__ import annotations

import numpy as np

from dm_autofocus.optics import depth_of_focus
from dm_autofocus.search.defocus_model import FocusLens

SIDE, FINER = 128, 2
LENS = FocusLens(aperture_radius=0.01, wavelength=550e-9, focal_length_px=1.3 * 0.02 / 550e-9)
DEPTH = depth_of_focus(LENS.aperture_radius, LENS.wavelength)


class DefocusedCamera:
    """Sees a texture (2 SIDE, 2 SIDE) that is sharp at the curvature `place` [1/m]; noise relative to the mean."""

    def __init__(self, texture: np.ndarray, place: float, noise: float = 0.01) -> None:
        self.place, self.noise = place, noise
        self._texture = np.fft.rfft2(texture)
        self._rng = np.random.default_rng(5)

    def expose(self, curvature: float) -> np.ndarray:
        """An image (SIDE, SIDE)."""
        fine = SIDE * FINER
        metres = np.arange(fine) * LENS.wavelength * LENS.focal_length_px * FINER / fine
        square = np.add.outer(*2 * [(metres - LENS.aperture_radius) ** 2])
        wave = 2 * np.pi / LENS.wavelength * (curvature - self.place) * square
        spread = np.abs(np.fft.fft2((square <= LENS.aperture_radius**2) * np.exp(1j * wave))) ** 2
        transfer = np.fft.rfft2(spread)
        image = np.fft.irfft2(self._texture * transfer / transfer[0, 0], (fine, fine))
        pixels = image.reshape(SIDE, FINER, SIDE, FINER).mean((1, 3))
        return 100 * (pixels + self.noise * self._rng.standard_normal(pixels.shape))


def clouds(seed: int = 1, contrast: float = 0.2) -> np.ndarray:
    """Detail at all scales, mean 1."""
    size = SIDE * FINER
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    frequency[0, 0] = np.inf
    grey = np.fft.irfft2(np.fft.rfft2(np.random.default_rng(seed).standard_normal((size, size))) / frequency)
    return 1 + contrast * grey / grey.std()
