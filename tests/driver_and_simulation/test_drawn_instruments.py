"""Interferometers with every error at once, drawn at random: what `./dm instrument` leaves is inside the bound told."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dm_calibration.acquisition.ingest import Ingest
from dm_calibration.interferometer_parameters import load_reference
from dm_calibration.map_files import SurfaceMap
from dm_common.figures import accuracy_text
from dm_common.optics.zernike import PISTON_TILT
from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.interferometer.zygo_files import encode_dat
from dm_simulation.mirror.zernike import Array, evaluate, terms_to_order
from simulated_instrument import FIELD, PIXELS, SETTINGS, run

Shape = Callable[[Array, Array], Array]
TERMS = terms_to_order(12)[PISTON_TILT:]
RADIUS = FIELD / 2
TILTS, FRINGES, AVERAGED, FLATS_AVERAGED = 20, 1.5e-6, 12, 4


def draw_instrument(rng: np.random.Generator) -> InterferometerConfig:
    """An instrument without a mirror's figure."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return InterferometerConfig(
        pixels=PIXELS,
        field_diameter=FIELD,
        figure_rms=0.0,
        pixel_noise=between(0.5e-9, 3e-9),
        low_order_noise=between(0.2e-9, 0.5e-9),
        tilt_spread=between(100e-9, 400e-9),
        instrument_error=between(5e-9, 50e-9),
        retrace=between(0.002, 0.02),
        distortion=float(rng.uniform(-0.006, 0.006)),
        vibration=between(0.3e-9, 3e-9),
        phase_steps=float(rng.uniform(0.0, 0.5)),
        mount_scale=float(rng.uniform(0.98, 1.02)),
    )


def draw_figure(rng: np.random.Generator, size: float) -> Shape:
    """Of a flat, or of a mirror: m over places in units of the field's radius."""
    amplitudes = size * rng.standard_normal(len(TERMS)) / np.array([term.n for term in TERMS]) ** 1.5
    return lambda x, y: np.asarray(evaluate(x, y, TERMS) @ amplitudes)


def in_front(flat: Shape, degrees: float = 0.0) -> Shape:
    """A flat in the place of the mirror, turned: the mirror image of what it is inside the instrument."""
    turn = np.exp(-1j * np.radians(degrees))

    def seen(x: Array, y: Array) -> Array:
        place = turn * (x + 1j * y)
        return flat(-place.real, place.imag)

    return seen


@dataclass
class DrawnInstrument:
    """The instrument of a seed, which writes its maps into `folder`."""

    seed: int
    folder: Path

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 15])
        self.config = draw_instrument(self.rng)

    def in_front_of(self, *shapes: Shape, **changed: Any) -> Interferometer:
        """The same errors whatever stands there."""

        def influence_at(x: Array, y: Array) -> Array:
            return np.sum([shape(x / RADIUS, y / RADIUS) for shape in shapes], axis=0)[..., None]

        optics = SimpleNamespace(diameter=FIELD, order=TERMS[-1].n)
        part: Any = SimpleNamespace(config=optics, radius=RADIUS, influence_at=influence_at)
        errors = np.random.default_rng([self.seed, 16])
        return Interferometer(replace(self.config, **changed), part, errors, self.rng)

    def take(self, count: int, *shapes: Shape, **changed: Any) -> list[Path]:
        instrument = self.in_front_of(*shapes, **changed)
        start = len(list(self.folder.glob("*.dat")))
        files = [self.folder / f"{number}.dat" for number in range(start, start + count)]
        for file in files:
            file.write_bytes(encode_dat(instrument.measure(np.ones(1)), instrument.pitch, self.config.wavelength, 0))
        return files

    def flats(self) -> Path:
        """The table of a three-flat test, A in the instrument."""
        b, c = (draw_figure(self.rng, 20e-9) for _ in range(2))
        inside_a: dict[str, Any] = {"mount_scale": 1.0}
        inside_b = inside_a | {"instrument_error": 0.0}
        rows = ["file,reference,part,degrees"]
        for names, shapes, changed in (
            ("A,B,0", (in_front(b),), inside_a),
            ("A,B,37", (in_front(b, 37.0),), inside_a),
            ("A,C,0", (in_front(c),), inside_a),
            ("B,C,0", (b, in_front(c)), inside_b),
            ("B,C,90", (b, in_front(c, 90.0)), inside_b),
        ):
            rows += [f"{file.name},{names}" for file in self.take(FLATS_AVERAGED, *shapes, **changed)]
        table = self.folder / "flats.csv"
        table.write_text("\n".join(rows))
        return table

    def marks(self) -> Path:
        """The table of a grid that was read to a twentieth of a pixel."""
        rows = ["column,row,x,y"]
        for true in (complex(x, y) / 5 for x in range(-4, 5) for y in range(-4, 5)):
            at = true * self.config.mount_scale
            at = at * (1.0 + self.config.distortion * abs(at) ** 2) * PIXELS / 2 + complex(*self.rng.normal(0, 0.05, 2))
            middle, metres = 0.5 * (PIXELS - 1), true * RADIUS
            rows.append(f"{middle + at.real:.3f},{middle - at.imag:.3f},{metres.real:.7f},{metres.imag:.7f}")
        table = self.folder / "marks.csv"
        table.write_text("\n".join(rows))
        return table


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_what_is_left_is_inside_the_absolute_bound(seed: int, tmp_path: Path) -> None:
    """Of the first 100 seeds 98 are, by a bound of 95 %."""
    drawn = DrawnInstrument(seed, tmp_path)
    figure, power = draw_figure(drawn.rng, 100e-9), 2e-6 * drawn.rng.uniform(-1.0, 1.0)  # m at the edge

    def mirror(x: Array, y: Array) -> Array:
        return figure(x, y) + power * (x**2 + y**2)

    found = run("flats", drawn.flats(), "--write", tmp_path / "flat.fits")
    found |= run("retrace", *drawn.take(TILTS, mirror, tilt_spread=FRINGES))
    maps = drawn.take(AVERAGED, mirror)
    found |= run("grid", drawn.marks(), maps[0])
    bounds = {name: found.pop(name) for name in ("instrument_error", "scale_error")}
    reference = load_reference(found.pop("reference_surface"), "", 0.0, 1e-9)
    settings = replace(SETTINGS, **found | {"reference": reference, "retrace": tuple(found["retrace"])})

    ingest, truth = Ingest(), drawn.in_front_of(mirror).true_sag(np.ones(1))
    true_scale = replace(SETTINGS, pitch=FIELD / PIXELS / drawn.config.mount_scale)
    wanted = ingest.measure(SurfaceMap(truth, 632.8e-9, None, "array"), true_scale)[1].coefficients
    plain, corrected = (
        np.array([ingest.read(file, used)[1].coefficients - wanted for file in maps])[:, PISTON_TILT:]
        for used in (SETTINGS, settings)
    )
    left, before = (np.abs(apart.mean(axis=0)).max() for apart in (corrected, plain))
    repeatable = 2.0 * corrected.std(axis=0, ddof=1).max() / np.sqrt(AVERAGED)
    calibration = SimpleNamespace(wavelength=632.8e-9, aperture_radius=SETTINGS.aperture_radius, **bounds)
    text = accuracy_text(float(repeatable), calibration, 2.0 * power / RADIUS**2)
    absolute = re.search(r"absolute to ([\d.]+) nm", text)
    assert absolute and left < 1e-9 * float(absolute[1]) < before > 4.0 * left, (left, before, text)
