"""Text of the report, part three: hysteresis, creep and recipes."""

from __future__ import annotations

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.report import hysteresis_figures
from dm_calibration.report.content import length, utc
from dm_calibration.report.document import Picture, Section, Table
from dm_common.recipes import terms_text

NM = 1e9


def hysteresis(calibration: Calibration) -> Section:
    """Loops and creep of the identified law."""
    title = "Hysteresis and creep"
    hysteresis = calibration.hysteresis
    if hysteresis is None:
        return Section(
            title,
            [
                "Not identified: the maps of this plan do not show hysteresis apart from the influence function. "
                "A calibration with the plan “hysteresis” does (./dm calibrate --plan hysteresis)."
            ],
        )
    law, wavelength = hysteresis.law, calibration.wavelength
    opening = hysteresis_figures.loop_opening(law)
    spread = f", {opening.min():.1%} to {opening.max():.1%} over the actuators" if law.actuators else ""
    shared = "the mean over actuators, whose laws are their own" if law.actuators else "all actuators share it"
    hour, day = 100 * (hysteresis_figures.step_response(law, np.array([3600.0, 86400.0])) - 1.0)
    rows = [
        ("class of law", hysteresis.name),
        ("maps it was identified from", str(hysteresis.maps)),
        ("opening of the full loop", f"{opening.mean():.1%} of the span{spread}"),
        ("creep", f"{law.creep_rate:.2%} of a step per decade of time"),
        ("growth of a step from 1 s to 1 h", f"{hour:.2f} %"),
        ("growth of a step from 1 s to 1 day", f"{day:.2f} %"),
        (
            "largest coefficient error of a predicted move, held out, 95 %",
            length(hysteresis.held_out_max_zernike, wavelength),
        ),
        ("standard deviation of an effective signal when the history is unknown", f"{hysteresis.unknown_sigma:.3f}"),
    ]
    pictures = [
        Picture(
            "loops",
            f"Loops of the identified law: {shared}; gains are in the influence function.",
            hysteresis_figures.loops_figure(law),
        )
    ]
    if law.creep_rate > 0.0:
        pictures.append(
            Picture(
                "creep",
                "Creep of the identified law after a step on a rested mirror.",
                hysteresis_figures.creep_figure(law),
            )
        )
    return Section(
        title,
        [
            "The effective signal is what sag and coefficients are linear in; it depends on the applied signal and on "
            "the turning points before it. A degauss wipes the loops, not the creep.",
            *hysteresis.remarks,
        ],
        [Table("The law", ("item", "value"), rows, textual=True)],
        pictures,
    )


def recipes(calibration: Calibration) -> Section:
    """Recipes with their re-measured errors."""
    book = calibration.recipes
    title = "Recipes: errors re-measured after the command"
    if not book.recipes:
        return Section(
            title,
            ["None are stored with this calibration, so none was re-measured. The action “build_recipes” builds them."],
        )
    rows = [
        (
            f"{recipe.curvature:+.4f}",
            f"{recipe.conic_constant:g}",
            terms_text(recipe.zernike) or "-",
            f"{recipe.max_zernike * NM:.2f}",
            f"{recipe.rms * NM:.2f}",
            str(recipe.maps),
            f"{recipe.signals.min():+.3f} … {recipe.signals.max():+.3f}",
        )
        for recipe in book.recipes
    ]
    header = ("curvature, 1/m", "conic", "added terms", "largest coefficient, nm", "rms sag, nm", "maps", "signals")
    return Section(
        title,
        [
            f"Each begins with a degauss of {book.degauss_steps} half-swings. The last was built {utc(book.stamp_ns)}. "
            "Halfway between neighbours the bound is larger than what was re-measured by "
            f"{length(book.interpolation_error, calibration.wavelength)} at most."
        ],
        [Table("Recipes", header, rows)],
        [Picture("recipes", "Re-measured errors of the recipes.", hysteresis_figures.recipes_figure(book))],
    )
