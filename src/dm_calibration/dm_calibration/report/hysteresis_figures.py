"""Figures of the hysteresis model: hysteresis loops and creep of the identified law, and the recipes."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dm_calibration.report.document import BLUE, GREEN, GREY, ORANGE, VERMILION
from dm_common.hysteresis.law_shape import branch, closed_cycle, opening, turned
from dm_common.hysteresis.model import HysteresisModel
from dm_common.recipes import RecipeBook

Floats = NDArray[np.float64]

NM = 1e9
#: Minor loops: from the falling branch, down to each of these and back.
MINOR_TURNS = (0.6, 0.2, -0.2, -0.6)
MINOR_DEPTH = 0.5
#: Times after a step, s.
CREEP_TIMES = np.geomspace(0.1, 1e5, 61)
#: From when on creep is counted, s.
CREEP_FROM = 1.0


def loop_opening(law: HysteresisModel) -> Floats:
    """(N,) largest distance of the branches of the full cycle, as a share of its span, of each law that there is."""
    return opening(*closed_cycle(law)[1:])


def step_response(law: HysteresisModel, time: Floats) -> Floats:
    """Effective signal `time` (T,) s after a step from 0 to +1 on a rested mirror, relative to that after 1 s.

    The mean over actuators whose laws are their own.
    """
    state = turned(law, (1.0,))
    grown = np.array([law.effective(law.advance(state, float(when))).mean() for when in time])
    return np.asarray(grown / law.effective(law.advance(state, CREEP_FROM)).mean())


def loops_figure(law: HysteresisModel) -> Figure:
    """The major loop with minor loops in it; beside it what remains without the straight line.

    The mean over actuators whose laws are their own.
    """
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    signals, rising, falling = closed_cycle(law)
    slope = (rising[-1] - rising[0]).mean() / 2.0
    middle = 0.5 * (rising[-1] + rising[0]).mean()
    ways: list[tuple[Floats, Floats, str, str]] = [
        (signals, rising, VERMILION, "rising"),
        (signals, falling, BLUE, "falling"),
    ]
    for turn in MINOR_TURNS:
        state = turned(law, (1.0, -1.0, 1.0, turn))
        for end in (turn + MINOR_DEPTH, turn):
            there, values, state = branch(law, state, min(end, 1.0))
            ways.append((there, values, GREY, "minor loops" if turn == MINOR_TURNS[0] and end != turn else ""))
    there, values, _ = branch(law, turned(law, ()), 1.0)
    ways.append((there, values, GREEN, "first rise after a degauss"))
    for there, own, colour, label in ways:
        values = own.mean(axis=1)
        left.plot(there, values, color=colour, linewidth=1.2, label=label or None)
        right.plot(there, 100 * (values - middle - slope * there) / (2.0 * slope), color=colour, linewidth=1.2)
    left.set(xlabel="applied signal", ylabel="effective signal")
    right.set(xlabel="applied signal", ylabel="departure from the straight line, % of the span")
    left.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    return figure


def creep_figure(law: HysteresisModel) -> Figure:
    """Growth of a step over decades of time."""
    figure = Figure(figsize=(10.5, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.semilogx(CREEP_TIMES, 100 * (step_response(law, CREEP_TIMES) - 1.0), color=BLUE)
    axes.set(xlabel="time after the step, s", ylabel=f"growth since {CREEP_FROM:g} s, % of the step")
    for when, name in ((60.0, "1 min"), (3600.0, "1 h"), (86400.0, "1 day")):
        axes.axvline(when, color=GREY, linewidth=0.8, linestyle=":")
        axes.text(when, axes.get_ylim()[0], f" {name}", fontsize=8, color=GREY, va="bottom")
    axes.grid(alpha=0.3)
    return figure


def recipes_figure(book: RecipeBook) -> Figure:
    """Re-measured errors of the recipes over curvature."""
    figure = Figure(figsize=(10.5, 3.2), layout="constrained")
    axes = figure.add_subplot()
    curvature = [recipe.curvature for recipe in book.recipes]
    for values, colour, marker, label in (
        ([recipe.max_zernike for recipe in book.recipes], BLUE, "o", "largest coefficient error"),
        ([recipe.rms for recipe in book.recipes], ORANGE, "s", "rms sag error"),
    ):
        axes.plot(curvature, np.array(values) * NM, marker, color=colour, label=label)
    axes.set(xlabel="curvature, 1/m (concave positive)", ylabel="re-measured error, nm", ylim=(0, None))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return figure
