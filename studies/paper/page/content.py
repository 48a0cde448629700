"""The page in words, part one: sample surfaces, regions, weights and regressions (sections 2 and 3.1)."""

from __future__ import annotations

import numpy as np

from dm_calibration.influence.surfaces import TABLE_1 as NAMES
from dm_calibration.report.document import Picture, Section, Table
from dm_common.optics.sample_regions import AREA_FRACTIONS
from studies.paper import reported
from studies.paper.page.figures import regional_errors_figure, regions_figure, weights_figure
from studies.paper.regions import OUTSIDE_MEAN, RegionStatistics
from studies.paper.results import STANDARD, Results
from studies.paper.samples import LINEAR, PIXELS, POINTS, Samples

NM = 1e9
#: Surfaces that move the central actuators, or one of the inner circles, against the others.
CENTRE_SURFACES = (*(f"p{k:02d}" for k in range(6, 13)), "p43", "p44", *(f"p{k}" for k in range(46, 55)))


def introduction(results: Results) -> Section:
    """What was run, and how to read the page."""
    config = results.options.bench
    return Section(
        "What this page shows",
        [
            "Tables 1–3 and Figs. 4–9 of “Learning Approach for Flexible Spherical/Aspherical Reflective Surface "
            "Control”, made anew by this suite on a virtual bench and set beside the paper's own values. The mirror is "
            "a model of the PDM30-37 (37 piezos, 30 mm plate, 22 mm working aperture, 8 µm stroke), solved as an "
            "elastic plate; the maps are those of an interferometer at 632.8 nm with its noise. Nothing that was "
            "fitted shares code with the bench.",
            f"{STANDARD.capitalize()}: hysteresis {config.hysteresis:.0%} of the stroke ({config.law}), creep "
            f"{config.creep:.0%} per decade of time, initial figure 40 nm rms, camera {config.pixels} × "
            f"{config.pixels}, seed {config.seed}. Ideal actuators: the same mirror without hysteresis and creep. What "
            "differs between the two is what hysteresis and creep cost.",
            "Numbers of this page come from this run; none is copied from an earlier one. The paper's numbers are "
            "marked as such.",
        ],
    )


def table_1(results: Results) -> Section:
    """The sample surfaces with their measured errors."""
    samples, ideal = results.standard.samples, results.ideal.samples
    rows = []
    for names, description in reported.TABLE_1:
        chosen = _group(names)
        rows.append((names, description, *(_median_range(each, chosen) for each in (samples, ideal))))
    maps = samples.calibration.maps
    return Section(
        "Table 1: the sample surfaces",
        [
            f"All {len(samples.labels)} surfaces were measured with the signals of the paper's Table 1, after a "
            f"degauss, with a push and a pull of each actuator and reference frames among them: {len(maps)} maps in "
            "all (the paper: more than 80). −1 and +1 are the ends of the stroke. Spheres and Zernike surfaces are "
            "solved on the influence function of the maps before them; the paper gives no amplitude for pz01–pz11, and "
            "half of the largest that the actuators allow is taken.",
            "The surface control error of a surface is the measured map less its nominal surface, the 21 Zernike terms "
            "that the influence function G predicts for its signals (G s, no offset), without piston and tilt. So it "
            "holds the initial figure, the print-through beyond 21 terms and what hysteresis and creep add.",
            "The paper takes p01–p05 and p46–p54 for the “degree of linearity of control” and gives no number for it. "
            "Here it is that of the 21 terms beyond tilt over the signal. What p01–p05 move alike is piston, which a "
            "map does not show: they show how the actuators differ.",
        ],
        [
            Table(
                "Table 1, with the rms surface control error over the whole aperture: median (smallest – largest), nm",
                ("surfaces", "signals and shapes, as in the paper", STANDARD, "ideal actuators"),
                rows,
            ),
            _linearity_table(results),
        ],
    )


def _linearity_table(results: Results) -> Table:
    """The degree of linearity, for which section 2.1 uses p01–p05 and p46–p54."""
    header, rows = ["surfaces"], []
    for name in results.benches:
        header += [f"{name}: nm rms per unit signal", "departure", "R²"]
    for group in LINEAR:
        row = [group]
        for each in results.benches.values():
            line = each.samples.linearity[group]
            row += [f"{line.rate * NM:.1f}", f"{line.departure:.2%}", f"{line.r2:.5f}"]
        rows.append(row)
    return Table(
        "Degree of linearity: rate of change, largest departure of a surface from a straight line as a share of the "
        "line's change over the range, and R²",
        header,
        rows,
    )


def _group(names: str) -> list[str]:
    """The surfaces of a row of Table 1: a name, "a, b", or "a–b"."""
    if "–" in names:
        first, last = names.split("–")
        return list(NAMES[NAMES.index(first) : NAMES.index(last) + 1])
    return names.split(", ")


def _median_range(samples: Samples, chosen: list[str]) -> str:
    errors = np.array([samples.regional[k, -1] for k, label in enumerate(samples.labels) if label in chosen]) * NM
    if not errors.size:
        return "–"
    return f"{np.median(errors):.0f} ({errors.min():.0f} – {errors.max():.0f})"


def figure_4(results: Results) -> Section:
    """The regions."""
    bench = results.standard.samples.bench
    return Section(
        "Fig. 4: regions",
        [
            "Ten concentric circular apertures with 10 … 100 % of the area, as in the paper. The outer actuators lie "
            "outside the working aperture, as the paper says of its own; it gives no diameter for it, and 22 mm of the "
            "30 mm plate is taken."
        ],
        pictures=[
            Picture("fig4", "Fig. 4: regions for calculation.", regions_figure(bench.mirror, bench.plate.radius * 2))
        ],
    )


def figure_5(results: Results) -> Section:
    """Regional errors."""
    rows = []
    for k, share in enumerate(AREA_FRACTIONS):
        row = [f"{share:.0%}"]
        for each in results.benches.values():
            for panel in (each.samples.actuator_surfaces, each.samples.zernike_surfaces):
                row.append(f"{panel.mean[k] * NM:.1f}")
                row.append(f"{panel.variance[k] * NM**2:.1f}")
        rows.append(row)
    header = ["area"]
    for name in results.benches:
        short = "ideal" if name != STANDARD else "standard"
        header += [f"{short} (a) mean nm", "var nm²", f"{short} (b) mean nm", "var nm²"]
    panels = {
        name: (each.samples.actuator_surfaces, each.samples.zernike_surfaces) for name, each in results.benches.items()
    }
    return Section(
        "Fig. 5: regional surface errors",
        [_rising(results), _readings(results), _variances(results), _zernike_exception(results)],
        [Table("Fig. 5 in numbers, on the sampling points", header, rows), _readings_table(results)],
        [
            Picture(
                "fig5",
                "Fig. 5: rms surface control error inside the regions. Dots: surfaces, spread sideways by number; "
                "line: mean; (b) leaves pz02 and pz03 out of the mean, as the paper does.",
                regional_errors_figure(panels),
            )
        ],
    )


def _rising(results: Results) -> str:
    mean = results.standard.samples.actuator_surfaces.mean * NM
    falls = int((np.diff(mean) < 0).sum())
    verdict = "in every step" if falls == 0 else f"in {9 - falls} of the 9 steps"
    ideal = results.ideal.samples
    figure = ideal.regional[ideal.labels.index("p03")] * NM
    return (
        f"(a) The paper: “mean values increase monotonically”. Here they go from {mean[0]:.1f} nm inside 10 % of the "
        f"area to {mean[-1]:.1f} nm over all of it and rise {verdict}. The initial figure, which "
        f"p03 on ideal actuators shows alone, goes from {figure[0]:.1f} to {figure[-1]:.1f} nm: how the mean runs with "
        "the radius is a property of the single mirror (here: of the seed). True errors implied by the paper's Table 3 "
        f"(Err / RelErr) are {_implied()}."
    )


def _readings(results: Results) -> str:
    """The readings of Fig. 5(a) whose mean rises in every step."""
    readings = results.standard.samples.readings
    rising = [name for name, panel in readings.items() if (np.diff(panel.mean) > 0).all()]
    others = [f"{name} ({_falls(panel)} of 9 steps fall)" for name, panel in readings.items() if name not in rising]
    points, pixels = readings[POINTS].mean, readings[PIXELS].mean
    apart = np.abs(points - pixels)
    region = int(np.argmax(apart))
    verdict = f"Rising in every step, as in the paper: {'; '.join(rising) or 'none'}." + (
        f" Not: {'; '.join(others)}." if others else ""
    )
    return (
        f"The paper takes its errors from 500 samples and does not say whether a region is levelled on its own. "
        f"{verdict} Sampling points and all pixels differ by {apart[region] * NM:.2f} nm at most, inside "
        f"{AREA_FRACTIONS[region]:.0%} of the area. Levelling each region on its own takes out piston and slope of the "
        "error inside it, which lowers the means of small regions most."
    )


def _falls(panel: RegionStatistics) -> int:
    return int((np.diff(panel.mean) <= 0).sum())


def _readings_table(results: Results) -> Table:
    columns = {
        f"{'standard' if bench == STANDARD else 'ideal'}, {name}": panel
        for bench, each in results.benches.items()
        for name, panel in each.samples.readings.items()
    }
    rows = [
        (f"{share:.0%}", *(f"{panel.mean[k] * NM:.2f}" for panel in columns.values()))
        for k, share in enumerate(AREA_FRACTIONS)
    ]
    rows.append(("steps that rise", *(f"{9 - _falls(panel)} of 9" for panel in columns.values())))
    return Table("Fig. 5(a) by reading: mean over p01–p58, nm", ("area", *columns), rows)


def _implied() -> str:
    values = [reported.implied_error_nm(name) for name in reported.TEST_SURFACES]
    return f"{min(values):.0f}–{max(values):.0f} nm"


def _variances(results: Results) -> str:
    samples = results.standard.samples
    panel, ideal = samples.actuator_surfaces, results.ideal.samples.actuator_surfaces
    here = (panel.variance[0] * NM**2, panel.variance[-1] * NM**2)
    far = np.argsort(-panel.rms[:, 0])[:5]
    deviation = np.square(panel.rms[:, 0] - panel.mean[0])
    share = deviation[far].sum() / deviation.sum()
    named = [panel.labels[k] for k in far]
    inner = sum(name in CENTRE_SURFACES for name in named)
    paper, other = reported.FIG_5A_VARIANCE_NM2, ideal.variance * NM**2
    return (
        f"The paper's variances are {paper[10]} nm² inside 10 % and {paper[100]} nm² inside 100 %; here they are "
        f"{here[0]:.0f} and {here[1]:.0f} nm² ({other[0]:.0f} and {other[-1]:.0f} nm² "
        f"with ideal actuators). The five surfaces with the largest errors in the smallest region, "
        f"{', '.join(named)}, make {share:.0%} of its variance; {inner} of them move the centre or a ring about it far "
        "against the actuators beside it. The 21 terms cannot follow such a bump: a small disc over it sees almost "
        "nothing else, the whole aperture averages it out. A variance that is small and grows outwards "
        "would need a mirror that prints through less: a stiffer plate, or a smaller true stroke than the published "
        "8 µm."
    )


def _zernike_exception(results: Results) -> str:
    parts = []
    for name, each in results.benches.items():
        panel = each.samples.zernike_surfaces
        whole = panel.rms[:, -1] * NM
        own = ", ".join(f"{whole[panel.labels.index(label)]:.0f}" for label in OUTSIDE_MEAN)
        variance = panel.variance * NM**2
        parts.append(
            f"{name}: {own} nm, the other nine {panel.mean[-1] * NM:.0f} nm in the mean with variances of "
            f"{variance.min():.1f} to {variance.max():.1f} nm² (all eleven: {whole.min():.0f} to {whole.max():.0f} nm)"
        )
    low, high = reported.FIG_5B_VARIANCE_NM2
    return (
        "(b) The paper excepts pz02 and pz03 for their larger errors; the variances of the other nine are "
        f"{low:.2f} to {high:.2f} nm². Here, for pz02 and pz03 over the whole aperture: {'; '.join(parts)}. With ideal "
        "actuators the Zernike surfaces differ by their print-through only; what sets single ones apart on the other "
        "bench is hysteresis, that is how far, and from where, the actuators moved, and not the term itself."
    )


def weights(results: Results) -> Section:
    """Why row weights cancel and where weights act."""
    samples = results.standard.samples
    weighting = samples.weighting
    gain = weighting.score_unweighted - weighting.score.min()
    verdict = (
        f"the best ε lowers the held-out error by {gain * NM:.3f} nm only"
        if gain > 0.0
        else "no ε predicts maps it has not seen better than equal weights do"
    )
    return Section(
        "Eqs. (6)–(8): region weights, and why they cancel in Eq. (7)",
        [
            "Eq. (7) puts a diagonal W on the rows of ΔC − GΔS. The Frobenius norm is a sum over rows, and each row of "
            "G occurs in one term of that sum only; a factor in front of a term does not move its minimum. So (7) has "
            "the same solution as (6), whatever W is. Solved on the sample surfaces with weights from 0.01 to 1, as "
            f"one problem in all entries of G at once, G changes by {samples.weights_cancel:.1e} m per unit signal at "
            f"most, {samples.weights_cancel / samples.influence_max:.0e} of its largest entry: rounding.",
            "Weights act where measurements of several regions share unknowns. There are two such places, and both are "
            "implemented: (a) the 21 coefficients of a map, fitted to the sag with the points of region i weighted by "
            "w_i, then Eq. (6) on them (this is AZWreg in the regressions below); (b) the command solve "
            "min ‖W(Δc − GΔs)‖ on the vector of sag points, which outnumber the actuators (this is AZWreg in the "
            "control experiments).",
            f"ε is left open (“a prior parameter”; the text then speaks of a β that no equation has). By "
            f"{weighting.folds}-fold cross-validation, {verdict}, and the weights chosen differ from 1 by "
            f"{np.abs(1.0 - weighting.weights).max():.0e} at most. To see what weights do, the control "
            "experiments also take ε = the median of the variances.",
        ],
        pictures=[
            Picture(
                "weights",
                "Weights of Eq. (8) and the choice of ε.",
                weights_figure(
                    {name: each.samples.weighting for name, each in results.benches.items()},
                    {name: each.samples.median_weights for name, each in results.benches.items()},
                ),
            )
        ],
    )
