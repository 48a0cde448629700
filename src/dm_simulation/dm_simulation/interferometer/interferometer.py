"""Maps of the plate as a Fizeau interferometer would measure them, with its noise, piston, tilt and dropouts.

Everything smooth (influence functions to order 36, initial figure, low-order noise, piston, tilt) is a polynomial in
x and y over the field, so a map is two thin matrix products, T(y) C T(x)^T with T the Chebyshev polynomials at the
pixel centres: about 3 ms for 944 x 944 pixels, and no influence maps to keep in memory.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from dm_common.values import parameter, real, switch, whole
from dm_simulation.mirror import zernike
from dm_simulation.mirror.membrane import Membrane
from dm_simulation.mirror.plate import Plate
from dm_simulation.mirror.zernike import Array

WAVELENGTH = 632.8e-9
#: Standard deviation, from map to map, of the logarithm of the amplitude of vibration.
VIBRATION_SPREAD = 0.8


@dataclass(frozen=True)
class InterferometerConfig:
    """The instrument: how maps differ from the surface."""

    pixels: int = parameter(
        whole(944, 32, 4096, "px"), "Pixels along each side of the camera; the circular field touches its edges."
    )
    field_diameter: float = parameter(
        real(0.022, 1e-3, 1.0, "m"), "Diameter of the field of view (the working aperture of the mirror)."
    )
    wavelength: float = parameter(real(WAVELENGTH, 1e-7, 2e-5, "m"), "Wavelength.")
    figure_rms: float = parameter(
        real(40e-9, 0.0, 1e-5, "m"),
        "Rms, inside the field, of the unpowered mirror's initial figure: orders 2-12 over the mirror, by the seed.",
    )
    pixel_noise: float = parameter(real(1e-9, 0.0, 1e-6, "m"), "White noise per pixel, rms.")
    low_order_noise: float = parameter(
        real(0.3e-9, 0.0, 1e-6, "m"),
        "Noise of all Zernike terms of orders 2-5 together, rms over the field.",
    )
    noise_time: float = parameter(
        real(0.0, 0.0, 1e5, "s"), "Correlation time of low_order_noise from map to map (1/e); 0 = not correlated."
    )
    piston_spread: float = parameter(real(200e-9, 0.0, 1e-4, "m"), "Standard deviation of piston between maps.")
    tilt_spread: float = parameter(
        real(300e-9, 0.0, 1e-4, "m"), "Standard deviation, between maps, of the edge sag due to each tilt."
    )
    instrument_error: float = parameter(
        real(0.0, 0.0, 1e-5, "m"),
        "Rms error that the instrument adds to every map, orders 2-12 over the field, by the seed; a map of it alone "
        "is output_folder/reference/flat.datx.",
    )
    retrace: float = parameter(
        real(0.0, 0.0, 0.1),
        "Retrace error, rms m per m of edge sag due to tilt in x or in y, orders 2-5, by the seed.",
    )
    distortion: float = parameter(
        real(0.0, -0.05, 0.05),
        "Radial distortion, with the cube of the distance from the centre: a point at the edge is seen further out by "
        "this share.",
    )
    vibration: float = parameter(
        real(0.0, 0.0, 1e-7, "m"),
        "Median amplitude of ripples at twice the fringe frequency; the amplitude differs from map to map.",
    )
    phase_steps: float = parameter(real(0.0, 0.0, 20.0), "Mean number of discs per map that are off by a whole fringe.")
    mask_diameter: float = parameter(
        real(0.0, 0.0, 1.0, "m"), "Diameter of a mask on the mirror that hides all beyond it; 0 = no mask."
    )
    specks: int = parameter(whole(400, 0, 1_000_000), "Mean number of dropped pixels per map.")
    blobs: int = parameter(
        whole(6, 0, 1000), "Dropped discs per map, 3 to 16 pixels in radius on a camera of 944 pixels."
    )
    mount_angle: float = parameter(
        real(0.0, -7.0, 7.0, "rad"),
        "Mounting of the mirror in the field of view: turned anticlockwise by this angle.",
    )
    mount_mirrored: bool = parameter(switch(False), "Mounting: mirrored left-right, before the turn.")
    mount_x: float = parameter(real(0.0, -0.1, 0.1, "m"), "Centre of the mirror in the field, x.")
    mount_y: float = parameter(real(0.0, -0.1, 0.1, "m"), "Centre of the mirror in the field, y.")
    mount_scale: float = parameter(
        real(1.0, 0.5, 2.0), "Error of the lateral scale: lengths as the instrument sees them / true lengths."
    )
    flip_x: bool = parameter(switch(False), "Picture mirrored left-right, after rotate_deg.")
    flip_y: bool = parameter(switch(False), "Picture mirrored upside down, after rotate_deg.")
    rotate_deg: int = parameter(whole(0, 0, 270, "deg"), "Picture turned anticlockwise by 0, 90, 180 or 270.")


class Interferometer:
    """The instrument in front of one mirror, whose influence on the sag is a polynomial.

    Args:
        figure_rng: draws the initial figure once.
        noise_rng: draws everything that differs from map to map.

    Attributes:
        pitch: m per pixel.
        aperture: (pixels, pixels) bool, True for pixels whose centre is inside the field.
        noise: the generator `noise_rng`; a copy of this object may be given its own.
    """

    def __init__(
        self,
        config: InterferometerConfig,
        plate: Plate | Membrane,
        figure_rng: np.random.Generator,
        noise_rng: np.random.Generator,
    ) -> None:
        if config.field_diameter > plate.config.diameter:
            raise ValueError(
                f"interferometer.field_diameter = {config.field_diameter:g} m: "
                f"must not exceed the mirror, {plate.config.diameter:g} m"
            )
        if config.rotate_deg not in (0, 90, 180, 270):
            raise ValueError(f"interferometer.rotate_deg = {config.rotate_deg}: must be 0, 90, 180 or 270")
        self.config = config
        self.pitch = config.field_diameter / config.pixels
        self.noise = noise_rng
        self._field_radius = config.field_diameter / 2
        degree = plate.config.order

        # Pixel centres in units of the field radius; row 0 is the top, y points up.
        centres = (2 * np.arange(config.pixels) + 1) / config.pixels - 1
        squares = np.add.outer(centres**2, centres**2)
        self.aperture: NDArray[np.bool_] = squares <= 1
        self._outside = ~self.aperture
        self._centres = centres
        # seen = true (1 + distortion true^2) in units of the field radius; `share` is true / seen.
        share = np.ones_like(squares)
        for _ in range(5):
            share = 1.0 / (1.0 + config.distortion * squares * share**2)
        true_y, true_x = -centres[:, None] * share, centres * share
        self._true_pixels = 0.5 * config.pixels * (np.array((-true_y, true_x)) + 1.0) - 0.5  # row, column
        x, y = self._on_mirror(true_x * self._field_radius, true_y * self._field_radius, config)
        edge = min(config.mask_diameter or np.inf, plate.config.diameter * (1 + 1e-9)) / 2
        self._outside |= np.hypot(x, y) > edge
        self._columns = chebyshev.chebvander(centres, degree)
        self._rows = self._columns[::-1].copy()

        # Coefficients of products T_p(y) T_q(x) by interpolation at Chebyshev points, exact for polynomials.
        nodes = chebyshev.chebpts1(degree + 1)
        inverse = np.linalg.inv(chebyshev.chebvander(nodes, degree))
        y, x = np.meshgrid(nodes, nodes, indexing="ij")

        def interpolate(values: Array) -> Array:
            return np.einsum("py,qx,yxk->kpq", inverse, inverse, values, optimize=True)

        aligned = replace(config, mount_x=0.0, mount_y=0.0, mount_scale=1.0)
        places = [self._on_mirror(x * self._field_radius, y * self._field_radius, each) for each in (config, aligned)]
        self._influence = interpolate(plate.influence_at(*places[0]))
        self._true_influence = self._influence if aligned == config else interpolate(plate.influence_at(*places[1]))
        # Over the field disc: piston, two tilts, then orders 2 to 5.
        self._low_orders = interpolate(zernike.evaluate(x, y, zernike.terms_to_order(5)))
        terms = zernike.terms_to_order(12)[3:]

        def drawn(size: float, *places: tuple[Array, Array], terms: tuple[zernike.Term, ...] = terms) -> list[Array]:
            """One random shape at each of these positions of the nodes; `size` is its rms at the first of them."""
            amplitudes = figure_rng.standard_normal(len(terms)) / np.array([term.n for term in terms]) ** 1.5
            shapes = [interpolate((zernike.evaluate(*at, terms) @ amplitudes)[..., None])[0] for at in places]
            inside = self._evaluate(shapes[0])[self.aperture]
            return [shape * (size / np.sqrt(np.mean((inside - inside.mean()) ** 2))) for shape in shapes]

        self._figure, self._true_figure = drawn(
            config.figure_rms, *((along_x / plate.radius, along_y / plate.radius) for along_x, along_y in places)
        )
        (self._error,) = drawn(config.instrument_error, (x, y))
        low_terms = zernike.terms_to_order(5)[3:]
        self._retrace = np.array([drawn(config.retrace, (x, y), terms=low_terms)[0] for _ in range(2)])
        self._lasting, self._measured = np.zeros(len(self._low_orders) - 3), -np.inf
        # Linear forms in the coefficients that give the sag at the edge by tilt: mean of f x divided by that of x^2.
        inside = np.where(x**2 + y**2 <= 1, 1.0, 0.0)
        products = chebyshev.chebvander(nodes, degree)
        self._tilts = np.array(
            [products.T @ (inside * along) @ products / (inside * along**2).sum() for along in (x, y)]
        )

    @staticmethod
    def _on_mirror(x: Array, y: Array, mount: InterferometerConfig) -> tuple[Array, Array]:
        """Positions in the field (m), converted to the frame of the mirror as it is mounted."""
        x, y = (x - mount.mount_x) / mount.mount_scale, (y - mount.mount_y) / mount.mount_scale
        cosine, sine = np.cos(mount.mount_angle), np.sin(mount.mount_angle)
        x, y = cosine * x + sine * y, cosine * y - sine * x
        return (-x if mount.mount_mirrored else x), y

    def surface(self, displacement: Array) -> Array:
        """The surface over the field, without the instrument's noise, for spring bases at `displacement` (N,), m.

        Returns:
            Sag in m as coefficients (p, q) of T_p(y) T_q(x), x and y in units of the field's radius.
        """
        return np.tensordot(displacement, self._influence, 1) + self._figure

    def true_surface(self, displacement: Array) -> Array:
        """The same without shift and scale error of the mount: in true lengths about the mirror's own centre."""
        return np.tensordot(displacement, self._true_influence, 1) + self._true_figure

    def _evaluate(self, coefficients: Array) -> Array:
        return (self._rows @ coefficients) @ self._columns.T

    def _camera(self, picture: Array) -> Array:
        """The map as the camera shows it: rotated, then flipped."""
        picture = np.rot90(picture, self.config.rotate_deg // 90)
        if self.config.flip_x:
            picture = picture[:, ::-1]
        return picture[::-1] if self.config.flip_y else picture

    def true_sag(self, displacement: Array) -> Array:
        """The noise-free surface (pixels, pixels), m, as the camera shows it, NaN outside: for evaluation only."""
        return self._shown(self._evaluate(self.surface(displacement)))

    def reference(self) -> Array:
        """The instrument's error (pixels, pixels), m: what it would show of a perfect flat without noise."""
        return self._shown(self._distorted(self._evaluate(self._error)))

    def _distorted(self, sag: Array) -> Array:
        if not self.config.distortion:
            return sag
        return np.asarray(map_coordinates(sag, self._true_pixels, order=3, mode="nearest"))

    def _shown(self, sag: Array) -> Array:
        sag[self._outside] = np.nan
        return self._camera(sag)

    def measure(self, displacement: Array, time: float = 0.0) -> Array:
        """A map of the surface with spring bases at `displacement` (N,), m: (pixels, pixels), m, NaN = no data.

        Args:
            time: s, of any clock; decides how much low-order noise is kept from the map before.
        """
        config, rng = self.config, self.noise
        low = np.empty(len(self._low_orders))
        low[0] = config.piston_spread * rng.standard_normal()
        low[1:3] = config.tilt_spread / 2 * rng.standard_normal(2)  # an orthonormal tilt is 2 at the edge
        lasts = np.exp(-abs(time - self._measured) / config.noise_time) if config.noise_time else 0.0
        low[3:] = config.low_order_noise / np.sqrt(len(low) - 3) * rng.standard_normal(len(low) - 3)
        low[3:] = lasts * self._lasting + np.sqrt(1.0 - lasts**2) * low[3:]
        self._lasting, self._measured = low[3:], time
        seen = self.surface(displacement) + self._error + np.tensordot(low, self._low_orders, 1)
        seen += np.tensordot(np.tensordot(self._tilts, seen, 2), self._retrace, 1)
        sag = self._distorted(self._evaluate(seen))
        if config.vibration:
            amplitude = config.vibration * rng.lognormal(0.0, VIBRATION_SPREAD)
            sag += amplitude * np.sin(8.0 * np.pi / config.wavelength * sag + rng.uniform(0.0, 2.0 * np.pi))
        noise = rng.standard_normal(sag.shape, dtype=np.float32)
        noise *= np.float32(config.pixel_noise)
        sag += noise
        for _ in range(rng.poisson(config.phase_steps) if config.phase_steps else 0):
            x, y, radius = *rng.uniform(-0.5, 0.5, 2), rng.uniform(0.1, 0.3)
            disc = np.add.outer((self._centres - y) ** 2, (self._centres - x) ** 2) <= radius**2
            sag[disc] += rng.choice((-0.5, 0.5)) * config.wavelength
        sag[self._outside] = np.nan
        self._drop_out(sag)
        return self._camera(sag)

    def _drop_out(self, sag: Array) -> None:
        """Lose single pixels (weak fringes) and a few discs (dust)."""
        size, rng = self.config.pixels, self.noise
        sag.flat[rng.integers(0, sag.size, rng.poisson(self.config.specks))] = np.nan
        for _ in range(self.config.blobs):
            row, column = rng.integers(0, size, 2)
            radius = rng.uniform(3, 16) * size / 944
            reach = int(radius) + 1
            rows = slice(max(row - reach, 0), row + reach + 1)
            columns = slice(max(column - reach, 0), column + reach + 1)
            y, x = np.ogrid[rows.start : min(rows.stop, size), columns.start : min(columns.stop, size)]
            sag[rows, columns][(y - row) ** 2 + (x - column) ** 2 <= radius**2] = np.nan
