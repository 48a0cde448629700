"""A camera that looks at a scene through the mirror; its images are computed from the true surface.

The mirror is in the entrance pupil (or in its image by an afocal relay), with a lens of fixed focus behind it. The
wavefront error of an object is twice the sag of the surface, figure and print-through included, plus the remaining
defocus between lens and object distance. The squared modulus of the pupil's Fourier transform is the point spread
function (Goodman, Introduction to Fourier Optics, 3rd ed., section 6.4), with which the object's texture is convolved.
Objects are side by side; that a near one hides parts of a blurred far one is neglected. Exposure is instantaneous.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import fft

from dm_common.values import live_parameter, parameter, real, reals, whole
from dm_simulation.mirror.zernike import Array

#: Surfaces that differ by less than this [m] over the whole pupil give the same image: creep at rest needs no new one.
SAME_SURFACE = 1e-9
#: Grey level of the scene's mean brightness.
MEAN_GREY = 100.0


@dataclass(frozen=True)
class CameraConfig:
    """The camera and its scene."""

    rate: float = parameter(real(0.0, 0.0, 200.0, "Hz"), "Images per second of wall time on image_raw; 0 = no camera.")
    width: int = parameter(whole(320, 16, 2048, "px"), "Image width.")
    height: int = parameter(whole(240, 16, 2048, "px"), "Image height.")
    pixel_pitch: float = parameter(real(3.45e-6, 1e-7, 1e-3, "m"), "Pixel pitch.")
    focal_length: float = parameter(real(0.2, 1e-3, 10.0, "m"), "Focal length of the lens.")
    rest_distance: float = parameter(
        real(10.0, 0.0, 1e6, "m"), "Object distance in focus while the mirror is flat; 0 = infinity."
    )
    relay_magnification: float = parameter(
        real(1.0, 0.01, 100.0), "Diameter of the beam on the mirror / diameter of the entrance pupil."
    )
    wavelength: float = parameter(real(550e-9, 1e-7, 2e-5, "m"), "Wavelength of the images.")
    distances: Sequence[float] = live_parameter(
        reals([6.0, 15.0, 100.0], 0.0, 1e6, "m"),
        "Distances of the objects, from left to right; 0 = infinity. Their number must not change.",
    )
    photons: float = parameter(
        real(5000.0, 1.0, 1e9), "Electrons per pixel at the mean grey level, which fixes the shot noise."
    )


def camera_matrix(config: CameraConfig) -> list[float]:
    """The nine elements of K in sensor_msgs/CameraInfo, row by row: focal length and centre [px]."""
    focal_length = config.focal_length / config.pixel_pitch / config.relay_magnification
    return [focal_length, 0.0, (config.width - 1) / 2, 0.0, focal_length, (config.height - 1) / 2, 0.0, 0.0, 1.0]


class SceneCamera:
    """Renders the scene for a surface.

    Args:
        config: camera and scene.
        pupil_diameter: diameter of the part of the mirror that is used, m.
        scene_rng: draws the textures once.
        noise_rng: draws the noise of each image.

    Raises:
        ValueError: an inconsistent configuration; the message names the parameter.
    """

    def __init__(
        self,
        config: CameraConfig,
        pupil_diameter: float,
        scene_rng: np.random.Generator,
        noise_rng: np.random.Generator,
    ) -> None:
        if not config.distances or min(config.distances) < 0:
            raise ValueError(f"camera.distances = {list(config.distances)}: must be one or more distances >= 0")
        # The FFT of a pupil plane with sides of `extent` gives a point spread function in pixels of the camera.
        extent = config.wavelength * config.focal_length / config.pixel_pitch
        if extent < pupil_diameter:
            raise ValueError(
                f"camera.pixel_pitch = {config.pixel_pitch:g} m: too coarse for the diffraction of a pupil of "
                f"{pupil_diameter:g} m; at most {config.wavelength * config.focal_length / pupil_diameter:.3g} m"
            )
        self.config = config
        self._noise = noise_rng
        self._size = fft.next_fast_len(max(config.width, config.height) + 64)
        pitch = extent / self._size
        count = math.floor(pupil_diameter / pitch)
        metres = (np.arange(count) - (count - 1) / 2) * pitch
        self._field = metres / (pupil_diameter / 2)
        squares = np.add.outer(metres**2, metres**2)
        self._aperture = (squares <= (pupil_diameter / 2) ** 2).astype(np.float32)
        self._half_square = (squares / 2).astype(np.float32)
        self._textures = [fft.rfft2(part) for part in self._scene(scene_rng)]
        self._last: tuple[Array, Array, NDArray[np.float32]] | None = None  # defocus, surface and its image
        self.place(config.distances)

    def left_to_focus(self, distances: Sequence[float]) -> Array:
        """Defocus of each object at these distances [m], as vergence at the mirror [1/m]: lens at rest minus object.

        Raises:
            ValueError: the number of objects differs.
        """
        if len(distances) != len(self.config.distances):
            raise ValueError(f"camera.distances = {list(distances)}: must stay {len(self.config.distances)} distances")
        at_mirror = [(1 / distance if distance else 0.0) for distance in (self.config.rest_distance, *distances)]
        return np.asarray((at_mirror[0] - np.array(at_mirror[1:])) / self.config.relay_magnification**2)

    def place(self, distances: Sequence[float]) -> None:
        """Move the objects to other distances [m]. Raises ValueError as `left_to_focus` does."""
        self._defocus = self.left_to_focus(distances)

    def _scene(self, rng: np.random.Generator) -> list[NDArray[np.float32]]:
        """One textured strip per object, side by side on the periodic plane: mean about 1, detail at all scales."""
        size, count = self._size, len(self.config.distances)
        frequency = np.hypot(*np.meshgrid(fft.fftfreq(size), fft.rfftfreq(size), indexing="ij"))
        frequency[0, 0] = np.inf
        y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
        owner = np.minimum(x * count // self.config.width, count - 1)
        strips = []
        for number in range(count):
            texture = fft.irfft2(fft.rfft2(rng.standard_normal((size, size))) / frequency, (size, size))
            texture /= texture.std()
            # Large shapes, so that the objects can be told apart by eye: bars, squares, rings.
            across = x - (number + 0.5) * self.config.width / count
            along = y - self.config.height / 2
            shape = (np.sin(along / 3), np.sin(across / 5) * np.sin(along / 5), np.sin(np.hypot(across, along) / 3))
            grey = np.clip(1 + 0.2 * texture + 0.3 * np.sign(shape[number % 3]), 0, None)
            strips.append((grey * (owner == number)).astype(np.float32))
        return strips

    def wavefronts(self, surface: Array) -> list[NDArray[np.float32]]:
        """Wavefront error (n, n) in m over the pupil for each object.

        Args:
            surface: sag in m as coefficients of T_p(y) T_q(x) over the pupil's square.
        """
        basis = chebyshev.chebvander(self._field, len(surface) - 1)
        doubled = (2 * basis @ surface @ basis.T).astype(np.float32)
        return [doubled + np.float32(defocus) * self._half_square for defocus in self._defocus]

    def expose(self, surface: Array) -> NDArray[np.uint8]:
        """An image (height, width) of the scene by a mirror of this surface (see `wavefronts`), 8 bit."""
        defocus, last = self._defocus, self._last  # taken once: objects may be moved meanwhile
        if last is None or last[0] is not defocus or 4 * np.abs(surface - last[1]).sum() > SAME_SURFACE:
            last = self._last = (defocus, surface, self._render(surface))
        ideal = last[2]
        noise = self._noise.standard_normal(ideal.shape, dtype=np.float32)
        noisy = ideal + np.sqrt(ideal / np.float32(self.config.photons)) * noise
        return np.clip(np.float32(MEAN_GREY) * noisy + 0.5, 0, 255).astype(np.uint8)

    def _render(self, surface: Array) -> NDArray[np.float32]:
        shape = (self._size, self._size)
        total = np.zeros((self._size, self._size // 2 + 1), np.complex64)
        wave = np.complex64(2j * np.pi / self.config.wavelength)
        for wavefront, texture in zip(self.wavefronts(surface), self._textures, strict=True):
            pupil = np.zeros(shape, np.complex64)
            count = len(wavefront)
            pupil[:count, :count] = self._aperture * np.exp(wave * wavefront)
            amplitude = fft.fft2(pupil, overwrite_x=True)
            transfer = fft.rfft2(amplitude.real**2 + amplitude.imag**2)
            total += texture * (transfer / transfer[0, 0])
        image = fft.irfft2(total, shape)[: self.config.height, : self.config.width]
        return np.maximum(image, 0).astype(np.float32)
