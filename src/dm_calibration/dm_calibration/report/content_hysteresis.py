"""Text of the report, part three: hysteresis, creep and recipes, with their figures."""

import numpy as np
from matplotlib.figure import Figure

from dm_calibration.calibration import Calibration
from dm_calibration.report.content import NM, length, utc
from dm_calibration.report.document import BLUE, GREEN, GREY, ORANGE, VERMILION, Picture, Section, Table
from dm_common import Floats
from dm_common.hysteresis.law_shape import branch, closed_cycle, opening, turned
from dm_common.hysteresis.model import HysteresisModel
from dm_common.recipes import RecipeBook, recipe_row

#: Minor loops, in shares of half the range: turning points on the falling branch, and the rise from each of them.
MINOR_TURNS = (0.6, 0.2, -0.2, -0.6)
MINOR_DEPTH = 0.5
#: Times after a step, s.
CREEP_TIMES = np.geomspace(0.1, 1e5, 61)
#: Time after a step from which on its growth counts as creep, s.
CREEP_FROM = 1.0


def loop_opening(law: HysteresisModel, low: float, high: float) -> Floats:
    """(N,) largest distance between the branches of a cycle `low` .. `high`, as a share of its span, for each law."""
    return opening(*closed_cycle(law, low, high)[1:])


def step_response(law: HysteresisModel, time: Floats) -> Floats:
    """Effective signal `time` (T,) s after a step from 0 to +1 on a rested mirror, relative to its value after 1 s.

    With a law per actuator: the mean over actuators.
    """
    state = turned(law, (1.0,))
    grown = np.array([law.effective(law.advance(state, float(when))).mean() for when in time])
    return np.asarray(grown / law.effective(law.advance(state, CREEP_FROM)).mean())


def loops_figure(law: HysteresisModel, low: float, high: float) -> Figure:
    """The loop `low` .. `high` with minor loops; beside it the deviation from the straight line.

    With a law per actuator: the mean over actuators.
    """
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    signals, rising, falling = closed_cycle(law, low, high)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    ends = rising[[0, -1]].mean(axis=1)
    ways: list[tuple[Floats, Floats, str, str]] = [
        (signals, rising, VERMILION, "rising"),
        (signals, falling, BLUE, "falling"),
    ]
    for number, turn in enumerate(centre + half * np.array(MINOR_TURNS)):
        state = turned(law, (high, low, high, turn), centre)
        for end in (min(turn + half * MINOR_DEPTH, high), turn):
            there, values, state = branch(law, state, end)
            ways.append((there, values, GREY, "" if number or end == turn else "minor loops"))
    there, values, _ = branch(law, turned(law, (), centre), high)
    ways.append((there, values, GREEN, "first rise after a degauss"))
    for there, own, colour, label in ways:
        values = own.mean(axis=1)
        left.plot(there, values, color=colour, linewidth=1.2, label=label or None)
        straight = np.interp(there, (low, high), ends)
        right.plot(there, 100 * (values - straight) / np.ptp(ends), color=colour, linewidth=1.2)
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
    largest, rms = np.array([(recipe.max_zernike, recipe.rms) for recipe in book.recipes]).T * NM
    axes.plot(curvature, largest, "o", color=BLUE, label="largest coefficient error")
    axes.plot(curvature, rms, "s", color=ORANGE, label="rms sag error")
    axes.set(xlabel="curvature, 1/m (concave positive)", ylabel="re-measured error, nm", ylim=(0, None))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return figure


def hysteresis(calibration: Calibration) -> Section:
    """Loops and creep of the identified law."""
    title = "Hysteresis and creep"
    hysteresis = calibration.hysteresis
    if hysteresis is None:
        text = (
            "Not identified: the maps of this plan do not show hysteresis apart from the influence function. A "
            "calibration with the plan “hysteresis” does (./dm calibrate --plan hysteresis)."
        )
        return Section(title, [text])
    law = hysteresis.law
    seen = calibration.fit.signal_min, calibration.fit.signal_max
    openings = loop_opening(law, *seen)
    spread = f", {openings.min():.1%} to {openings.max():.1%} over the actuators" if law.actuators else ""
    shared = "the mean over actuators, whose laws are their own" if law.actuators else "all actuators share it"
    hour, day = 100 * (step_response(law, np.array([3600.0, 86400.0])) - 1.0)
    rows = [
        ("class of law", hysteresis.name),
        ("maps it was identified from", str(hysteresis.maps)),
        ("opening of the loop over the signals seen", f"{openings.mean():.1%} of the span{spread}"),
        ("creep", f"{law.creep_rate:.2%} of a step per decade of time"),
        ("growth of a step from 1 s to 1 h", f"{hour:.2f} %"),
        ("growth of a step from 1 s to 1 day", f"{day:.2f} %"),
        ("standard deviation of an effective signal when the history is unknown", f"{hysteresis.unknown_sigma:.3f}"),
    ]
    caption = f"Loops of the identified law: {shared}; gains are in the influence function."
    pictures = [Picture("loops", caption, loops_figure(law, *seen))]
    if law.creep_rate > 0.0:
        caption = "Creep of the identified law after a step on a rested mirror."
        pictures.append(Picture("creep", caption, creep_figure(law)))
    text = (
        "The effective signal is what sag and coefficients are linear in; it depends on the applied signal and on the "
        "turning points before it. A degauss wipes the loops, not the creep."
    )
    table = Table("The law", ("item", "value"), rows, textual=True)
    return Section(title, [text, *hysteresis.remarks], [table], pictures)


def recipes(calibration: Calibration) -> Section:
    """Recipes with their re-measured errors."""
    book = calibration.recipes
    title = "Recipes: errors re-measured after the command"
    if not book.recipes:
        text = "None are stored with this calibration, so none was re-measured. The action “build_recipes” builds them."
        return Section(title, [text])
    ranges = (f"{recipe.signals.min():+.3f} … {recipe.signals.max():+.3f}" for recipe in book.recipes)
    rows = [(*recipe_row(recipe), reach) for recipe, reach in zip(book.recipes, ranges, strict=True)]
    header = ("curvature, 1/m", "conic", "added terms", "largest coefficient, nm", "rms sag, nm", "maps", "signals")
    last = max(recipe.stamp_ns for recipe in book.recipes)
    text = (
        f"Each begins with a degauss of {book.degauss_steps} half-swings. The last was built {utc(last)}. "
        "Halfway between neighbours the bound is larger than what was re-measured by "
        f"{length(book.interpolation_error, calibration.wavelength)} at most."
    )
    picture = Picture("recipes", "Re-measured errors of the recipes.", recipes_figure(book))
    return Section(title, [text], [Table("Recipes", header, rows)], [picture])
