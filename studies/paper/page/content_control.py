"""The page in words, part three: control experiments (section 3.2), open readings, and claims that do not survive."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dm_calibration.report.document import Picture, Section, Table
from dm_common.optics.conic import conic_coefficients, conic_sag, disc_coefficients
from dm_common.optics.zernike import PISTON_TILT
from studies.paper import reported
from studies.paper.control import LOOP_HYSTERESIS, LOOP_MAPS, METHODS, OPEN_HYSTERESIS
from studies.paper.page.content_coefficients import FIGURES, SHOWN, WITH, best, parts
from studies.paper.page.control_figures import surfaces_figure
from studies.paper.regressions import LEVEL
from studies.paper.results import STANDARD, BenchResults, Results

NM = 1e9


def controlled_surfaces(results: Results) -> Section:
    """Figs. 6 and 7."""
    radius = results.standard.samples.bench.mirror.working_radius
    medians = {
        method: [
            f"{name} {np.median([shot.rms for shot in bench.spheres[method, SHOWN].shots]) * NM:.1f} nm"
            for name, bench in results.benches.items()
        ]
        for method in FIGURES
    }
    pictures = []
    for method, (number, _) in FIGURES.items():
        series = {name: bench.spheres[method, SHOWN] for name, bench in results.benches.items()}
        title = f"spheres from p55 / p56 {WITH[method]} ({method})"
        pictures.append(
            Picture(
                f"fig{number}",
                f"Fig. {number}: measured surfaces ({STANDARD}), and measured less wanted surface of each bench; "
                "piston and tilt removed.",
                surfaces_figure(series, radius, title),
            )
        )
    saturation = max(shot.overflow for shot in results.standard.spheres["AZreg", SHOWN].shots)
    return Section(
        "Figs. 6 and 7: controlled surfaces",
        [
            "Spheres from −0.05 to +0.05 1/m, each started from the nearer of the initial states p55 and p56 (R = "
            "±60 m): the mirror goes there, its surface c_ini is measured, and it moves on by the Δs that the solver "
            "finds for c − c_ini. One move, no correction.",
            f"Median rms sag error over the spheres: with region weights {', '.join(medians['AZWreg'])}; without "
            f"{', '.join(medians['AZreg'])}. The weighted solve minimises the error of the sag itself, the "
            "other that of the 21 coefficients only, whatever lies beyond them (the coefficients follow below). The "
            "paper's figures are pictures without a scale of errors. The best command inside the stroke leaves "
            f"{results.standard.limit_rms * NM:.1f} nm rms of the strongest sphere, by the influence function"
            + (f"; signals asked for exceed the range by up to {saturation:.2f} and are cut." if saturation else "."),
        ],
        pictures=pictures,
    )


def conics(results: Results) -> Section:
    """Conic bases with and without an additive deviation."""
    radius = results.standard.samples.bench.mirror.working_radius
    rows = []
    for name, bench in results.benches.items():
        for method, series in bench.aspheres.items():
            for shot in series.shots:
                target = shot.target
                added = " + 100 nm Z₄⁰" if target.zernike else ""
                rows.append(
                    (
                        f"{name}, {method}, c = {target.curvature:+.2f} 1/m, κ = {target.conic_constant:g}{added}",
                        f"{shot.max_zernike * NM:.2f}",
                        parts(shot.max_zernike),
                        f"{shot.rms * NM:.1f}",
                    )
                )
    curvature = reported.CURVATURE_RANGE[1]
    difference = float(abs(conic_sag(radius, 0.0, curvature, -1.0) - conic_sag(radius, 0.0, curvature, 0.0)))
    tilt = curvature * radius**2
    header = ("bench, method, target", "largest coeff. nm", "", "rms sag nm")
    same = [shot for shot in results.standard.aspheres["AZreg"].shots if not shot.target.zernike]
    apart = [abs(a.max_zernike - b.max_zernike) for a, b in pairwise(same) if a.target.curvature == b.target.curvature]
    return Section(
        "Conic bases, Eqs. (2) and (3)",
        [
            f"At these curvatures a paraboloid and a sphere differ by {difference * NM:.1e} nm at the rim: the conic "
            "constant of Eq. (2) has no effect that any interferometer could show, and the aspheres of such a mirror "
            "are made by the additive deviation of Eq. (3), here 100 nm of Z₄⁰.",
            "So κ = −1 and κ = −10 ask for the same surface and the same signals. With hysteresis the errors of the "
            f"two differ by up to {max(apart) * NM:.0f} nm all the same, because they came from different surfaces.",
            "The vertex shift s of Eq. (2) drops out: it lifts a sphere and tilts it by c s, and piston and tilt of a "
            f"map are those of the alignment. With the vertex at the rim, s = {radius * 1e3:.0f} mm, the tilt is "
            f"{tilt * 1e6:.1f} µm at the rim, and what s adds beyond tilt {vertex_shift_left(radius) * NM:.1e} nm.",
        ],
        [Table("Conics from p55 / p56, c_ini measured", header, rows)],
    )


def vertex_shift_left(radius: float) -> float:
    """Largest coefficient beyond tilt, m, that the strongest sphere gains with its vertex moved to the rim."""
    curvature = reported.CURVATURE_RANGE[1]
    moved = disc_coefficients(lambda x, y: conic_sag(radius * (x + 1.0), radius * y, curvature))
    return float(np.abs(moved - conic_coefficients(curvature, 0.0, radius))[PISTON_TILT:].max())


def readings(results: Results) -> Section:
    """What the paper leaves open."""
    rows = [
        ("working aperture", "not given", "22 mm of the 30 mm plate"),
        ("r_i of Eq. (8)", "variance over surfaces / of a surface", "over the surfaces of Table 1, nm²"),
        ("points of region i", "ring between two discs / whole disc", "ring, so that equal weights are no weights"),
        ("place of W", "rows of Eq. (7) (cancels) / sag fit / command solve", "sag fit and command solve"),
        ("ε", "prior parameter, no value", "cross-validation; the median of r shown beside it"),
        ("nominal surface", "signals' 21 terms G s / the shape aimed at", "G s: it exists for every surface"),
        (
            "AZWreg in Tables 2, 3",
            "another G / weighted response / WLS / all regions",
            "G by weighted sag fit, and WLS",
        ),
        ("stepwise thresholds", "not given", "linear: 0.05 to enter, 0.10 to leave; else over the candidates"),
        ("candidates", "linear / with a predicted error", "history; linear beside it"),
        ("c_ini of section 3.2", "stored / measured before the move", "both run; measured shown"),
        ("“1st–6th order”", "orders 1–6 / six orders n = 0 … 5", "n = 0 … 5, judged beyond tilt"),
        ("errors after control", "one more map / the true surface", "both; shares within λ/n are of the true surface"),
        (
            "regions of Fig. 5",
            "all pixels / 500 samples; levelled once / each",
            "samples, levelled once; others beside",
        ),
        ("amplitude of pz01–pz11", "not given", "half of what the actuators allow"),
        ("“variance” of errors in Fig. 5", "over surfaces", "unbiased, divisor surfaces − 1"),
    ]
    return Section(
        "What the paper leaves open, and what was taken",
        [],
        [Table("Readings", ("what", "possible readings", "taken"), rows, textual=True)],
    )


def claims(results: Results) -> Section:
    """The paper's claims and what became of them, in numbers of this run."""
    standard, ideal = results.standard, results.ideal
    weighted, plain = (standard.spheres[method, SHOWN] for method in ("AZWreg", "AZreg"))
    ratio = float(np.median(weighted.true_max_zernike) / np.median(plain.true_max_zernike))
    loop, following = (best(standard, reading) for reading in ("closed loop", LOOP_HYSTERESIS))
    return Section(
        "Claims that do not survive an honest bench",
        [
            "“… we adjust the actuators in different partial regions, and we identify a new IF” by the weights of "
            "Eq. (7): they cancel and give the old one, see above (largest change of G: "
            f"{standard.samples.weights_cancel:.1e} m per unit signal).",
            "“… reduced from 1/50 λ to 1/1000 λ” in open loop: with hysteresis, λ/1000 was reached on "
            f"{_best_share(standard):.0%} of the spheres by the best method in one move; on ideal actuators on "
            f"{_best_share(ideal):.0%}, where the noise of a map ({ideal.samples.noise * NM:.2f} nm) is of the size of "
            f"λ/1000 ({reported.WAVELENGTH / 1000 * NM:.2f} nm). What gets there with hysteresis is no other influence "
            f"function but maps, {LOOP_MAPS} of them, with a model of hysteresis and creep: "
            f"{following.share_within(reported.CLAIM_PARTS[1]):.0%} of the spheres "
            f"({loop.share_within(reported.CLAIM_PARTS[1]):.0%} with maps alone); with the model and no map the median "
            f"is {parts(float(np.median(best(standard, OPEN_HYSTERESIS).true_max_zernike)))}.",
            "“Using the improved IF … the surface control errors of PDM30-37 were compensated”: the largest "
            f"coefficient error with weights is {ratio:.2f} times that without, in the median over the spheres, on the "
            "bench with hysteresis. Hysteresis of an actuator is the same for all regions of the aperture, so no "
            "weighting of regions can take it out.",
            "Both models “are significant at the 5% significance level”: after stepwise selection that is true of "
            f"{standard.regressions.shuffled_below(LEVEL):.0%} of shuffled data sets as well, see Table 2.",
        ],
    )


def _best_share(bench: BenchResults) -> float:
    """Share of the spheres within the paper's better mark, by the best method in the reading shown."""
    mark = reported.CLAIM_PARTS[1]
    return max(bench.spheres[method, SHOWN].share_within(mark) for method in METHODS)
