"""The page in words, part four: coefficient errors of controlled spheres, Figs. 8 and 9, and what limits them."""

from __future__ import annotations

import numpy as np

from dm_calibration.report.document import Picture, Section, Table
from studies.paper import reported
from studies.paper.control import (
    LOOP_HYSTERESIS,
    LOOP_MAPS,
    METHODS,
    OPEN_HYSTERESIS,
    READINGS,
    Series,
    share_within,
)
from studies.paper.page.control_figures import coefficients_figure, sweep_figure
from studies.paper.results import IDEAL, LAW_METHOD, STANDARD, BenchResults, Results

NM = 1e9
#: The reading shown in Figs. 6 and 7: open loop, from a start that was measured just before the move.
SHOWN = "measured"
#: Numbers of the paper's figures by method: measured surfaces, coefficient errors.
FIGURES = {"AZWreg": (6, 8), "AZreg": (7, 9)}
WITH = {"AZWreg": "with region weights", "AZreg": "without region weights"}
#: Parts of the wavelength within which spheres are counted; two of them are the paper's.
MARKS = (50, 100, 200, 500, 1000)
#: Method of the table by radial order.
BY_ORDER = "AZreg"


def parts(length: float) -> str:
    """A length as a part of the wavelength."""
    return f"λ/{reported.WAVELENGTH / length:.0f}"


def coefficient_errors(results: Results) -> Section:
    """Figs. 8 and 9 with the table of all methods and readings."""
    standard = results.standard
    pictures = []
    for method, (_, number) in FIGURES.items():
        series = {
            f"{STANDARD}, open loop": standard.spheres[method, SHOWN],
            f"{STANDARD}, closed loop": standard.spheres[method, "closed loop"],
            f"{STANDARD}, closed loop with hysteresis": standard.spheres[method, LOOP_HYSTERESIS],
            f"{IDEAL}, open loop": results.ideal.spheres[method, SHOWN],
        }
        pictures.append(
            Picture(
                f"fig{number}",
                f"Fig. {number}: coefficient errors of the controlled spheres, one dot for each sphere and term, "
                f"of the noise-free surface; closed loops take {LOOP_MAPS} maps.",
                coefficients_figure(series, f"coefficient errors {WITH[method]} ({method})"),
            )
        )
    shown = {
        name: [series for (method, _), series in bench.spheres.items() if method in FIGURES]
        for name, bench in results.benches.items()
    }
    pictures.append(
        Picture(
            "sweep",
            "Largest coefficient error of the noise-free surface against curvature, for each reading.",
            sweep_figure(shown),
        )
    )
    tables = [_methods_table(results), _orders_table(results)]
    if results.law_spheres:
        tables.append(_laws_table(results))
    return Section(
        "Figs. 8 and 9: coefficient errors",
        [
            "The paper: “the 1st–6th-order errors are fully corrected, the Zernike coefficient of the surface shape "
            "residual error is reduced from 1/50 λ to 1/1000 λ”. Its 21 terms end at order 5; the six orders can only "
            "be n = 0 … 5. Piston and tilt are no property of the mirror in an interferometer, so orders 2 to 5 are "
            "judged. "
            f"The largest coefficient moves by {standard.samples.noise * NM:.2f} nm "
            f"({parts(standard.samples.noise)}) from map to map of a mirror at rest, so a single map cannot show "
            "λ/1000. A virtual bench knows the noise-free surface: the spheres are counted by that, and the errors on "
            "one more, noisy map stand beside it. Neither was seen by the control.",
            *(_verdict(name, bench) for name, bench in results.benches.items()),
            _hysteresis_bound(results),
            _loops(standard),
            *([_foreign(results)] if results.law_spheres else []),
        ],
        tables,
        pictures,
    )


def best(bench: BenchResults, reading: str) -> Series:
    """The best method in a reading, by the median over the spheres."""
    each = [bench.spheres[method, reading] for method in METHODS]
    return min(each, key=lambda series: float(np.median(series.true_max_zernike)))


def _verdict(name: str, bench: BenchResults) -> str:
    sentences = []
    for reading in READINGS:
        if (BY_ORDER, reading) not in bench.spheres:
            continue
        series = best(bench, reading)
        median = float(np.median(series.true_max_zernike))
        sentences.append(
            f"{reading}: {series.method}, {median * NM:.2f} nm ({parts(median)}), "
            + ", ".join(f"λ/{mark} in {series.share_within(mark):.0%}" for mark in reported.CLAIM_PARTS)
            + " of the spheres"
        )
    return f"{name.capitalize()}, best method by median of the largest coefficient error: {'; '.join(sentences)}."


def _hysteresis_bound(results: Results) -> str:
    """Two measurements that show what limits a linear model."""
    standard, ideal = results.standard, results.ideal
    radius = standard.samples.bench.mirror.working_radius
    errors = []
    for shot in standard.spheres["AZreg", SHOWN].shots:
        start = np.copysign(1.0 / 60.0, 1.0 if shot.start == "p55" else -1.0)
        commanded = (shot.target.curvature - start) * radius**2 / 4.0
        errors.append(abs(shot.zernike[3] / commanded))
    spread = standard.branch_spread
    return (
        "Why the open loop cannot get there with a linear G. First, a command stands for more than one surface: p55 "
        f"reached from −0.05 and from +0.05 1/m differs by {spread * NM:.0f} nm in one coefficient "
        f"({ideal.branch_spread * NM:.1f} nm with ideal actuators). c = Gs gives one surface for both, so it is wrong "
        f"by {0.5 * spread * NM:.0f} nm ({parts(0.5 * spread)}) at least for one of them; that is what a stored c_ini "
        "meets. Second, when c_ini is measured, the step itself errs: after a turn of direction a piezo moves less for "
        f"the same signal than on average, and G is the average. Defocus missed the step asked for by "
        f"{np.median(errors):.0%} in the median and by {max(errors):.0%} at most. Only measuring and correcting, or a "
        "model of hysteresis and creep, goes further."
    )


def _loops(bench: BenchResults) -> str:
    """What limits the closed loops and the open loop that follows hysteresis."""
    plain, following, opened = (bench.spheres[BY_ORDER, r] for r in ("closed loop", LOOP_HYSTERESIS, OPEN_HYSTERESIS))
    worst = following.true_max_zernike.max()
    return (
        f"What limits the closed loop: each correction misses by what its own turns of direction cost, and one factor, "
        f"watched from step to step, cannot know which actuators turn ({BY_ORDER}: median "
        f"{np.median(plain.true_max_zernike) * NM:.2f} nm, worst {plain.true_max_zernike.max() * NM:.2f} nm after "
        f"{LOOP_MAPS} maps). With hysteresis, the commands come from a model of hysteresis and creep that was "
        f"identified from the maps of the calibration ({bench.samples.hysteresis.name}, creep "
        f"{bench.samples.hysteresis.law.creep_rate:.2%} per decade), followed through all commands since the degauss. "
        f"Without any map such a command errs by {np.median(opened.true_max_zernike) * NM:.1f} nm "
        f"({parts(float(np.median(opened.true_max_zernike)))}) in the median, which is the model's own misfit; after "
        f"{LOOP_MAPS} maps by {np.median(following.true_max_zernike) * NM:.2f} nm "
        f"({parts(float(np.median(following.true_max_zernike)))}), {worst * NM:.2f} nm ({parts(worst)}) at worst, "
        "which is the noise of the maps, averaged as far as the moves between them allow. In both loops the last "
        "correction is made but not measured any more; the judging map comes after it and is not counted."
    )


def _foreign(results: Results) -> str:
    """Accuracy with the identified model on mirrors that follow another law."""

    def median(law: str, reading: str) -> str:
        length = float(np.median(results.law_spheres[law][reading].true_max_zernike))
        return f"{length * NM:.1f} nm ({parts(length)})"

    each = [
        f"{law}: {median(law, 'stored')} without the model and {median(law, OPEN_HYSTERESIS)} with it in open loop, "
        f"{median(law, 'closed loop')} and {median(law, LOOP_HYSTERESIS)} after {LOOP_MAPS} maps"
        for law in results.law_spheres
    ]
    return (
        f"Identified on mirrors that follow other laws, medians: {'; '.join(each)}. In open loop the model has to be "
        "right over the whole stroke; in a closed loop it only has to predict the response of the next small move."
    )


def _shares(errors: np.ndarray) -> tuple[str, ...]:
    return tuple(f"{share_within(errors, mark):.0%}" for mark in MARKS)


_MARKS = tuple(f"λ/{mark}" for mark in MARKS)


def _row(name: str, series: Series) -> tuple[str, ...]:
    worst = series.true_max_zernike
    return (
        name,
        f"{np.median(worst) * NM:.2f}",
        parts(float(np.median(worst))),
        f"{worst.max() * NM:.2f}",
        f"{np.median(series.max_zernike) * NM:.2f}",
        *_shares(worst),
        f"{np.median([shot.rms for shot in series.shots]) * NM:.1f}",
        f"{np.mean([shot.maps for shot in series.shots]):.1f}",
    )


_COLUMNS = ("median", "", "worst", "on a map", *_MARKS, "rms sag", "maps")


def _methods_table(results: Results) -> Table:
    rows = [
        _row(f"{name}, {method}, {reading}", series)
        for name, bench in results.benches.items()
        for (method, reading), series in bench.spheres.items()
    ]
    return Table(
        "Largest coefficient error of the true surface over the spheres, nm, and its median on a map; share of the "
        "spheres within parts of λ; median rms sag error, nm; maps taken for control",
        ("bench, method, reading", *_COLUMNS),
        rows,
    )


def _laws_table(results: Results) -> Table:
    rows = [
        _row(f"{law}, {LAW_METHOD}, {reading}", series)
        for law, by_reading in results.law_spheres.items()
        for reading, series in by_reading.items()
    ]
    return Table(
        "The same on mirrors with hysteresis laws that play operators do not hold as a special case",
        ("law, method, reading", *_COLUMNS),
        rows,
    )


def _orders_table(results: Results) -> Table:
    rows = []
    for name, bench in results.benches.items():
        for (method, reading), series in bench.spheres.items():
            if method != BY_ORDER:
                continue
            for order, errors in enumerate(series.order_errors.T, start=2):
                median = float(np.median(errors))
                cells = (f"{median * NM:.2f}", parts(median), f"{errors.max() * NM:.2f}", *_shares(errors))
                rows.append((f"{name}, {reading}, order {order}", *cells))
    return Table(
        f"By radial order: largest coefficient error of the true surface over the spheres, {BY_ORDER}, nm",
        ("bench, reading, order", "median", "", "worst", *_MARKS),
        rows,
    )
