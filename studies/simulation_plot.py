"""A picture of what the virtual bench simulates: `python -m studies.simulation_plot --output bench.png`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import lsq_linear

from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.mirror.hysteresis import LAWS
from dm_simulation.mirror.piezo import PiezoActuators, PiezoConfig
from dm_simulation.mirror.plate import Plate
from dm_simulation.mirror.zernike import Array

#: Perceptually uniform and readable with any colour vision.
COLOURS = "cividis"
DARK, LIGHT, WARM = "#00204d", "#7c7b78", "#c2410c"
PIXELS = 400


class View:
    """The mirror as seen by a noise-free camera over the working aperture."""

    def __init__(self, plate: Plate, seed: int) -> None:
        rng = np.random.default_rng(seed)
        config = InterferometerConfig(pixels=PIXELS, figure_rms=0.0)
        self.plate = plate
        self.camera = Interferometer(config, plate, rng, rng)
        self.radius = config.field_diameter / 2
        self.x = (np.arange(PIXELS) - (PIXELS - 1) / 2) * self.camera.pitch
        self.y = self.x[::-1]

    def show(self, figure: Figure, axes: Axes, sag_nm: Array, title: str, label: str) -> None:
        """Draw a map in nm with the actuators inside it."""
        half = self.radius * 1e3
        image = axes.imshow(sag_nm, cmap=COLOURS, extent=(-half, half, -half, half), origin="upper")
        inside = np.hypot(self.plate.x, self.plate.y) < self.radius
        axes.plot(
            self.plate.x[inside] * 1e3, self.plate.y[inside] * 1e3, ".", color="white", ms=4, mec="black", mew=0.4
        )
        axes.set(
            title=title, xlabel="x / mm", ylabel="y / mm", xticks=np.arange(-10, 11, 5), yticks=np.arange(-10, 11, 5)
        )
        axes.spines[:].set_visible(False)
        figure.colorbar(image, ax=axes, label=label, shrink=0.86)


def sphere_command(view: View, curvature: float, stroke: float) -> tuple[Array, Array, Array]:
    """Best signals inside -1..+1 for a sphere, piston and tilt free; the resulting surface and the residual.

    Returns:
        signals (37,); sag, its tilt removed, and residual (pixels, pixels) in m.
    """
    x, y = np.meshgrid(view.x, view.y)
    inside = view.camera.aperture
    x, y = x[inside][::7], y[inside][::7]
    target = curvature * (x**2 + y**2) / (1 + np.sqrt(1 - curvature**2 * (x**2 + y**2)))
    free = np.stack([np.ones_like(x), x / view.radius, y / view.radius], axis=1)
    micrometre = 1e-6
    response = np.hstack([view.plate.influence_at(x, y) * stroke / 2 / micrometre, free])
    bound = np.r_[np.ones(len(view.plate.x)), np.full(3, np.inf)]
    solution = lsq_linear(response, target / micrometre, (-bound, bound)).x
    signals = solution[:-3]
    sag = view.camera.true_sag(signals * stroke / 2)
    x, y = np.meshgrid(view.x, view.y)
    with np.errstate(invalid="ignore"):
        wanted = curvature * (x**2 + y**2) / (1 + np.sqrt(1 - curvature**2 * (x**2 + y**2)))
    sag += (np.stack([np.ones_like(x), x / view.radius, y / view.radius], -1) @ solution[-3:]) * micrometre
    return signals, sag, sag - wanted


def draw_hysteresis(axes: Axes, config: PiezoConfig) -> None:
    """The full loop from rest, with minor loops in it."""
    actuator = PiezoActuators(replace(config, gain_spread=0.0, creep=0.0), _rng(), np.zeros(1))

    def drive(*turns: float) -> tuple[Array, Array]:
        signals = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(turns)])
        micrometres = []
        for signal in signals:
            actuator.apply(np.array([signal]), 0.0)
            micrometres.append(actuator.displacement[0] * 1e6)
        return signals, np.array(micrometres)

    axes.plot(*drive(0, 1), color=LIGHT, lw=1.2, ls="--", label="from rest")
    axes.plot(*drive(1, -1, 1), color=DARK, lw=1.8, label="full loop")
    axes.plot(*drive(1, -0.2, 0.6, -0.2, 1), color=WARM, lw=1.1, label="minor loop")
    axes.set(
        title=f"Hysteresis, {config.law.replace('_', ' ')}, {100 * config.hysteresis:g} %",
        xlabel="signal",
        ylabel="base displacement / µm",
    )
    axes.legend(frameon=False, loc="upper left")
    axes.grid(alpha=0.25)


def draw_creep(axes: Axes, config: PiezoConfig) -> None:
    """Displacement after a step, against the logarithmic law."""
    actuator = PiezoActuators(replace(config, gain_spread=0.0, law="none"), _rng(), np.zeros(1))
    actuator.apply(np.ones(1), 0.0)
    times = np.geomspace(0.01, 1e6, 200)
    percent = []
    for time in times:
        actuator.advance(time)
        percent.append(100 * (actuator.displacement[0] / (config.stroke / 2) - 1))
    axes.semilogx(times, percent, color=DARK, lw=1.8, label="simulated")
    law = np.geomspace(config.creep_fastest, config.creep_slowest, 2)
    start = np.interp(1.0, times, percent) - 100 * config.creep
    axes.semilogx(
        law,
        start + 100 * config.creep * np.log10(law / config.creep_fastest),
        color=WARM,
        lw=1.1,
        ls="--",
        label="∝ log t",
    )
    axes.set(
        title=f"Creep, {100 * config.creep:g} % per decade",
        xlabel="time after the step / s",
        ylabel="growth of the step / %",
    )
    axes.legend(frameon=False, loc="upper left")
    axes.grid(alpha=0.25)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def draw(output: Path, poke: int, curvature: float, config: PiezoConfig, seed: int) -> None:
    """Write the picture; the suffix of `output` gives the format."""
    view = View(Plate(), seed)
    count = len(view.plate.x)
    if not 1 <= poke <= count:
        raise ValueError(f"--poke {poke}: must be 1 to {count}")
    figure = Figure(figsize=(13.5, 7.6), layout="constrained")
    axes = figure.subplots(2, 3)
    figure.suptitle("Virtual PDM30-37, 22 mm working aperture, noise-free", fontsize=14)

    one = np.zeros(count)
    one[poke - 1] = config.stroke / 2
    view.show(
        figure,
        axes[0, 0],
        view.camera.true_sag(one) * 1e9,
        f"Influence function of actuator {poke}",
        "sag per unit signal / nm",
    )
    signals, sag, residual = sphere_command(view, curvature, config.stroke)
    sag_nm = (sag - np.nanmean(sag)) * 1e9
    view.show(figure, axes[0, 1], sag_nm, f"Sphere, curvature {curvature:g} 1/m", "sag less mean and tilt / nm")
    rms = float(np.sqrt(np.nanmean(residual**2)) * 1e9)
    view.show(figure, axes[0, 2], residual * 1e9, f"What the actuators cannot reach: {rms:.1f} nm rms", "residual / nm")

    axes[1, 0].bar(np.arange(1, count + 1), signals, color=DARK, width=0.75)
    axes[1, 0].axhline(0, color=LIGHT, lw=0.8)
    axes[1, 0].set(
        title="Signals of that sphere", xlabel="actuator", ylabel="signal", ylim=(-1, 1), xlim=(0, count + 1)
    )
    axes[1, 0].grid(alpha=0.25, axis="y")
    draw_hysteresis(axes[1, 1], config)
    draw_creep(axes[1, 2], config)
    figure.savefig(output, dpi=110)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit status 0 when the picture is written."""
    standard = PiezoConfig()
    parser = argparse.ArgumentParser(prog="python -m studies.simulation_plot", description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="picture file (.png, .svg, .pdf)")
    parser.add_argument("--poke", type=int, default=1, help="actuator whose influence function is shown, 1 to 37")
    parser.add_argument(
        "--curvature", type=float, default=0.05, help="curvature of the sphere, 1/m, positive = concave"
    )
    parser.add_argument("--law", choices=LAWS, default=standard.law, help="hysteresis law")
    parser.add_argument(
        "--hysteresis", type=float, default=standard.hysteresis, help="loop opening over the full stroke"
    )
    parser.add_argument("--creep", type=float, default=standard.creep, help="creep per decade of time")
    options = parser.parse_args(arguments)
    config = PiezoConfig(law=options.law, hysteresis=options.hysteresis, creep=options.creep)
    try:
        draw(options.output, options.poke, options.curvature, config, seed=1)
    except (ValueError, OSError) as error:
        print(f"plot: {error}", file=sys.stderr)
        return 1
    print(options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
