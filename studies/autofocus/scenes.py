"""Scenes drawn at random, seen through a mirror: `dm compare --autofocus` judges searches on them.

Shares no code with the model of `dm_autofocus`: the image is the texture convolved with the squared modulus of the
Fourier transform of the pupil (Goodman, Introduction to Fourier Optics, section 6.4), twice as fine as the camera's
pixels, which then integrate. Drawn are the optics, the mirror's residual aberrations and the error of each of its
moves, the spectrum of the light and of the texture, vignetting, flicker, noise and the bits of the camera, and in some
scenes a background at another distance. The optical parameters given to a search are wrong by some per cent.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Floats = NDArray[np.float64]

#: Image [px along a side], and the factor by which it is rendered finer than its pixels.
SIZE, FINER = 256, 2
#: Range of the mirror's curvature [1/m].
RANGE = 0.05
TEXTURES = ("cloud", "leaves", "text", "points", "grating", "tiles", "soft")
#: A texture that is not drawn at random: a part of the photograph that Matplotlib ships.
PHOTOGRAPH = "photograph"


@dataclass(frozen=True)
class Scene:
    """One camera, one object, one start.

    Attributes:
        seed: everything is drawn from it.
        texture: one of TEXTURES, or PHOTOGRAPH; "" = none at all.
        object_curvature: of the mirror at which the object has no defocus [1/m].
        background: the same for the surroundings of the object; None = there are none.
        start: curvature of the mirror before the search [1/m].
        aperture_radius: of the beam on the mirror [m].
        wavelengths: of the light [m], equal shares.
        focal_length_px: of the lens, in pixels.
        contrast: standard deviation of the texture over its mean.
        photons: electrons per pixel at the mean grey level.
        read_noise: electrons.
        bits: of the camera.
        region_px: side of the square region of interest, in the middle.
        move_error: standard deviation of the curvature that a move ends at [1/m].
        aberration: rms of the residual aberrations, as surface [m].
        misinformed: factors by which the focal length and aperture radius given to the search are wrong.
    """

    seed: int
    texture: str
    object_curvature: float
    background: float | None
    start: float
    aperture_radius: float
    wavelengths: tuple[float, ...]
    focal_length_px: float
    contrast: float
    photons: float
    read_noise: float
    bits: int
    region_px: int
    move_error: float
    aberration: float
    misinformed: tuple[float, float]

    @property
    def wavelength(self) -> float:
        """Mean wavelength [m]."""
        return float(np.mean(self.wavelengths))

    @property
    def depth_of_focus(self) -> float:
        """Curvature error at which the wavefront error at the edge is a quarter wave [1/m]."""
        return self.wavelength / 4 / self.aperture_radius**2


def draw_scene(seed: int, textured: bool = True) -> Scene:
    """Draw the scene of a seed, with or without a texture to focus on."""
    rng = np.random.default_rng((17, seed))
    radius = rng.uniform(9e-3, 11.5e-3)
    wavelength = rng.uniform(450e-9, 650e-9)
    sampling = rng.uniform(1.0, 1.9)  # wavelength * f-number / pixel pitch
    spectrum = (0.92, 1.0, 1.08) if rng.random() < 0.4 else (1.0,)
    place = rng.uniform(-0.95, 0.95) * RANGE
    behind = rng.random() < 0.2
    return Scene(
        seed=seed,
        texture=str(rng.choice(TEXTURES)) if textured else "",
        object_curvature=place,
        background=rng.uniform(-1.2, 1.2) * RANGE if behind and textured else None,
        start=rng.uniform(-1, 1) * RANGE,
        aperture_radius=radius,
        wavelengths=tuple(wavelength * factor for factor in spectrum),
        focal_length_px=sampling * 2 * radius / wavelength,
        contrast=float(np.exp(rng.uniform(np.log(0.05), np.log(0.4)))),
        photons=float(np.exp(rng.uniform(np.log(300), np.log(30000)))),
        read_noise=rng.uniform(1, 8),
        bits=int(rng.choice((8, 8, 10, 12))),
        region_px=int(rng.choice((96, 128, 160, 192))),
        move_error=rng.uniform(0.0, 0.15) * wavelength / 4 / radius**2,
        aberration=rng.uniform(5e-9, 40e-9),
        misinformed=(1 + rng.normal(0, 0.02), 1 + rng.normal(0, 0.02)),
    )


@dataclass
class SceneCamera:
    """Takes images of a scene.

    Attributes:
        scene: what is seen.
        images: number of images taken.
    """

    scene: Scene
    images: int = 0
    _pupils: list[tuple[NDArray[np.complex64], Floats, float]] = field(init=False)

    def __post_init__(self) -> None:
        scene = self.scene
        self._rng = np.random.default_rng((18, scene.seed))
        self._fine = SIZE * FINER
        self._vignetting, self._pattern = self._draw_sensor()
        self._layers = self._draw_layers() if scene.texture else []
        self._pupils = [self._draw_pupil(length) for length in scene.wavelengths] if scene.texture else []

    def region(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the region of interest as shares of the image."""
        share = self.scene.region_px / SIZE
        return (1 - share) / 2, (1 - share) / 2, share, share

    def expose(self, curvature: float) -> NDArray[np.uint16]:
        """An image (SIZE, SIZE) after a move to a curvature [1/m]."""
        self.images += 1
        scene, rng = self.scene, self._rng
        reached = curvature + scene.move_error * rng.standard_normal()
        ideal = np.ones((SIZE, SIZE))
        if self._layers:
            total = sum(texture * self._transfer(reached - place) for texture, place in self._layers)
            fine = fft.irfft2(total, (self._fine, self._fine))
            ideal = np.maximum(fine.reshape(SIZE, FINER, SIZE, FINER).mean((1, 3)), 0)
        flicker = 1 + 0.04 * rng.standard_normal()
        electrons = scene.photons * flicker * self._vignetting * ideal
        noisy = rng.poisson(electrons) * self._pattern + scene.read_noise * rng.standard_normal(electrons.shape)
        full = 2**scene.bits - 1
        return np.clip(np.round(noisy / scene.photons * 0.3 * full), 0, full).astype(np.uint16)

    def _transfer(self, defocus: float) -> NDArray[np.complex64]:
        """Optical transfer function on the half plane of `rfft2`, mean over the wavelengths."""
        total = np.zeros((self._fine, self._fine // 2 + 1), np.complex64)
        for pupil, square, wave in self._pupils:
            count = len(square)
            padded = np.zeros((self._fine, self._fine), np.complex64)
            padded[:count, :count] = pupil * np.exp(1j * wave * defocus * square).astype(np.complex64)
            spread = np.abs(fft.fft2(padded, overwrite_x=True)) ** 2
            transfer = fft.rfft2(spread)
            total += transfer / transfer[0, 0]
        return total / len(self._pupils)

    def _draw_pupil(self, wavelength: float) -> tuple[NDArray[np.complex64], Floats, float]:
        """Pupil with its residual aberrations, squared radius on the mirror [m^2] and wave number [1/m]."""
        scene = self.scene
        pitch = wavelength * scene.focal_length_px * FINER / self._fine
        count = min(int(np.ceil(2 * scene.aperture_radius / pitch)) + 1, self._fine)
        metres = (np.arange(count) - (count - 1) / 2) * pitch
        x, y = np.meshgrid(metres / scene.aperture_radius, metres / scene.aperture_radius)
        square = x**2 + y**2
        inside = square <= 1
        rng = np.random.default_rng((19, scene.seed))  # the same surface for each wavelength
        shapes = (
            x**2 - y**2,
            2 * x * y,
            (3 * square - 2) * x,
            (3 * square - 2) * y,
            x**3 - 3 * x * y**2,
            3 * x**2 * y - y**3,
            6 * square**2 - 6 * square + 1,
            (4 * square - 3) * (x**2 - y**2),
            (4 * square - 3) * 2 * x * y,
        )
        surface = sum(weight * shape for weight, shape in zip(rng.standard_normal(len(shapes)), shapes, strict=True))
        # Print-through of the actuators: ripples of their pitch.
        surface = surface + 0.5 * np.cos(14 * x + rng.uniform(0, 6)) * np.cos(14 * y + rng.uniform(0, 6))
        surface *= scene.aberration / surface[inside].std()
        wave = 2 * np.pi / wavelength
        pupil = inside * np.exp(1j * wave * 2 * surface)
        return pupil.astype(np.complex64), square * scene.aperture_radius**2, wave

    def _draw_sensor(self) -> tuple[Floats, Floats]:
        """Brightness over the image by vignetting and lamps; gain of each pixel."""
        rng = self._rng
        y, x = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
        vignetting = 1 - rng.uniform(0, 0.3) * (x**2 + y**2) / 2
        vignetting *= 1 + rng.uniform(-0.2, 0.2) * x + rng.uniform(-0.2, 0.2) * y
        return vignetting, 1 + 0.005 * rng.standard_normal((SIZE, SIZE))

    def _draw_layers(self) -> list[tuple[NDArray[np.complex64], float]]:
        """Fourier transform of the texture at each distance, and the curvature that focuses on it."""
        scene, rng = self.scene, self._rng
        here = _texture(scene.texture, scene.contrast, self._fine, rng)
        if scene.background is None:
            return [(fft.rfft2(here.astype(np.float32)), scene.object_curvature)]
        y, x = np.mgrid[: self._fine, : self._fine] - self._fine / 2
        reach = FINER * scene.region_px * rng.uniform(0.55, 0.8)
        inside = (np.abs(x) < reach) & (np.abs(y) < reach)
        behind = _texture(str(rng.choice(TEXTURES)), scene.contrast, self._fine, rng)
        parts = ((here * inside, scene.object_curvature), (behind * (1.0 - inside), scene.background))
        return [(fft.rfft2(part.astype(np.float32)), place) for part, place in parts]


def _texture(kind: str, contrast: float, size: int, rng: np.random.Generator) -> Floats:
    """Brightness (size, size), periodic: mean 1, standard deviation `contrast`, nowhere below 0."""
    y, x = np.mgrid[:size, :size]
    if kind in ("cloud", "soft"):
        frequency = np.hypot(*np.meshgrid(fft.fftfreq(size), fft.rfftfreq(size), indexing="ij"))
        frequency[0, 0] = np.inf
        shape = frequency ** -rng.uniform(0.6, 1.6)
        if kind == "soft":
            shape = shape * np.exp(-((frequency * FINER * rng.uniform(8, 25)) ** 2))
        grey = fft.irfft2(fft.rfft2(rng.standard_normal((size, size))) * shape, (size, size))
    elif kind == "leaves":
        grey = np.zeros((size, size))
        for _ in range(400):
            radius = FINER * 2 * rng.power(1.5) ** -1.5
            away = (x - rng.uniform(0, size) + size / 2) % size - size / 2
            down = (y - rng.uniform(0, size) + size / 2) % size - size / 2
            grey[away**2 + down**2 < min(radius, size / 4) ** 2] = rng.uniform(0, 1)
    elif kind == "text":
        letter = FINER * rng.integers(2, 5)
        cells = rng.random((size // letter + 1, size // letter + 1)) < 0.4
        cells[rng.random(len(cells)) < 0.3] = False  # between the lines
        grey = 1.0 - np.kron(cells, np.ones((letter, letter)))[:size, :size]
    elif kind == "points":
        grey = np.zeros((size, size))
        count = rng.integers(20, 300)
        grey[rng.integers(0, size, count), rng.integers(0, size, count)] = rng.exponential(1, count)
        grey = ndimage.gaussian_filter(grey, FINER * 0.5, mode="wrap")
    elif kind == "grating":
        waves = rng.integers(size // (FINER * 24), size // (FINER * 4), 2) * rng.choice((0, 1, -1), 2)
        waves = waves if waves.any() else np.array([size // (FINER * 8), 0])
        grey = np.tanh(rng.uniform(0.5, 5) * np.sin(2 * np.pi * (waves[0] * x + waves[1] * y) / size))
    elif kind == PHOTOGRAPH:
        grey = part_of_photograph(size, rng)
    else:
        side = FINER * rng.integers(6, 20)
        grey = rng.random((size // side + 1, size // side + 1)).repeat(side, 0).repeat(side, 1)[:size, :size]
        grey = grey + 0.3 * ((x % side < FINER) | (y % side < FINER))
    grey = (grey - grey.mean()) / grey.std()
    return 1 + min(contrast, -1 / float(grey.min())) * grey


def part_of_photograph(size: int, rng: np.random.Generator) -> Floats:
    """Grey levels (size, size) from anywhere in the photograph that Matplotlib ships, mirrored or not."""
    from matplotlib import image as images
    from matplotlib.cbook import get_sample_data

    photograph = images.imread(get_sample_data("grace_hopper.jpg", asfileobj=False)).astype(float).mean(2)
    down, right = (rng.integers(0, side - size + 1) for side in photograph.shape)
    return photograph[down : down + size, right : right + size][:: rng.choice((1, -1)), :: rng.choice((1, -1))]
