"""The page in words: 500 sampling points, as the paper takes them, against every pixel (section 2.2)."""

from __future__ import annotations

import numpy as np

from dm_calibration.report.document import Picture, Section, Table
from dm_common.optics.zernike import PISTON_TILT, TERM_RMS, TERMS
from studies.paper.page.figures import sampling_figure
from studies.paper.results import Results
from studies.paper.sampling_study import SamplingResult

NM = 1e9
#: Names of the ways of sampling in `studies.paper.sampling_study`: the paper's, that with area weights, every pixel.
PAPERS, WEIGHTED, FULL = "edge-clustered", "edge-clustered, area-weighted", "full map"


def sampling(results: Results) -> Section:
    """The sampling study."""
    study = results.sampling
    ways = study.results
    rows = [
        (
            name,
            f"{way.samples}",
            f"{way.bias_rms * NM:.3f}",
            f"{way.noise_rms * NM:.3f}",
            f"{way.rim_ringing_rms * NM:.2f}",
            f"{way.rim_ringing_peak * NM:.1f}",
            f"{way.rim_error_rms * NM:.2f}",
        )
        for name, way in ways.items()
    ]
    by_order = [(name, *(f"{value * NM:.3f}" for value in _by_order(way))) for name, way in ways.items()]
    orders = sorted({term.n for term in TERMS[PISTON_TILT:]})
    return Section(
        "Section 2.2: 500 samples instead of all pixels",
        [
            f"The paper fits its 21 terms to 500 points that crowd towards the edge. Here {study.surfaces} surfaces "
            "of Table 1 were sampled in four ways. The noise-free coefficients of all pixels count as true. Bias is "
            f"what a noise-free map gives wrong: {study.beyond_rms * NM:.1f} nm rms of these surfaces lie beyond the "
            f"21 terms and leak into them. Noise is that of {study.pixel_noise * NM:g} nm per pixel over {study.draws} "
            "maps; the low-order noise of the instrument passes any sampling and is left out. Ringing is how far the "
            "fitted terms leave the true ones on the outermost 10 % of the area.",
            f"The paper's points, fitted with equal weights, have {_ratio(ways[PAPERS], ways[WEIGHTED]):.1f} times the "
            "bias of the same points weighted by the area they stand for: equal weights count the rim several times "
            "over. They follow the surface on the rim "
            + ("more" if ways[PAPERS].rim_error_rms < ways[FULL].rim_error_rms else "less")
            + f" closely than the fit to all pixels ({ways[PAPERS].rim_error_rms * NM:.2f} against "
            f"{ways[FULL].rim_error_rms * NM:.2f} nm rms) and pay with the coefficients of the whole aperture. This "
            "suite fits all pixels and keeps the samples for the sag beyond the terms.",
        ],
        [
            Table(
                "Ways to sample a map; errors as rms sag without piston and tilt",
                ("way", "samples", "bias nm", "noise nm", "ringing, rim rms nm", "ringing, peak nm", "rim error nm"),
                rows,
            ),
            Table(
                "Bias by radial order, rms over surfaces, as rms sag, nm",
                ("way", *(f"order {n}" for n in orders)),
                by_order,
            ),
        ],
        [
            Picture(
                "sampling",
                "Bias of each coefficient by the way of sampling, rms over the surfaces. The full map is the reference "
                "and has none.",
                sampling_figure(study),
            )
        ],
    )


def _by_order(way: SamplingResult) -> np.ndarray:
    """(4,) m rms: bias of the radial orders 2 to 5."""
    power = np.square(way.bias * TERM_RMS)
    orders = np.array([term.n for term in TERMS])
    return np.sqrt([power[orders == n].sum() for n in sorted(set(orders[PISTON_TILT:].tolist()))])


def _ratio(a: SamplingResult, b: SamplingResult) -> float:
    return a.bias_rms / b.bias_rms
