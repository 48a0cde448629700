"""Text of the report, part one: key figures, provenance, warnings and limitations, all maps, files."""

import itertools
import time
from collections import Counter
from pathlib import PurePath

import numpy as np

from dm_calibration.calibration import POKE_CHECK, Calibration
from dm_calibration.influence.quality import GRADE_NAMES
from dm_calibration.report.document import Section, Table
from dm_common.figures import counted, with_wavelengths

NM = 1e9
#: Number of hexadecimal digits of a file's SHA-256 shown in the table of maps.
SHA_SHOWN = 12


def utc(time_ns: int) -> str:
    """A time as text."""
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(time_ns * 1e-9))


def length(metres: float, wavelength: float) -> str:
    """A length in nm, and as a fraction of the wavelength if that is known."""
    if not np.isfinite(metres):
        return "not known"
    return with_wavelengths(f"{metres * NM:.2f} nm", metres, wavelength)


def summary(calibration: Calibration) -> Section:
    """Key figures."""
    fit, hysteresis, wavelength = calibration.fit, calibration.hysteresis, calibration.wavelength
    grades = Counter(GRADE_NAMES[grade] for grade in fit.grades)
    recipes = [recipe.max_zernike for recipe in calibration.recipes.recipes]
    remeasured = length(max(recipes), wavelength) if recipes else "not measured"
    move = "largest coefficient error of a move in open loop, held out, 95 %"
    allowed = ", with what hysteresis may add" if hysteresis is None else ""
    rows = [
        ("residual sag of the maps used, in-sample", length(fit.in_sample_rms, wavelength)),
        ("residual sag of maps held out of the fit", length(fit.held_out_rms, wavelength)),
        (
            f"largest coefficient error, held out, 95 % of the maps{allowed}",
            length(fit.held_out_max_zernike, wavelength),
        ),
        *([(move, length(hysteresis.held_out_max_zernike, wavelength))] if hysteresis is not None else []),
        ("largest coefficient error, re-measured (recipes)", remeasured),
        ("figure drift during the run, rms", length(fit.drift_rms, wavelength)),
        ("condition number (rms-normalised modes)", f"{fit.condition_number:.1f}"),
        ("actuators", ", ".join(f"{count} {name}" for name, count in grades.items())),
        ("signals seen", f"{fit.signal_min:+.3f} … {fit.signal_max:+.3f}"),
    ]
    if hysteresis is None:
        kind = (
            "This calibration is linear, without hysteresis: after any move, hysteresis and creep leave an error that "
            "depends on the moves before. The held-out residual includes it."
        )
    else:
        kind = (
            f"This calibration holds a hysteresis model ({hysteresis.name}). Its influence function acts on "
            "effective signals, which follow from the history of all moves since the last degauss."
        )
    dropped, warnings = calibration.maps_dropped, len(calibration.limitations)
    counts = (
        f"{counted(dropped, 'map was', 'maps were')} dropped; "
        f"{counted(warnings, 'warning or limitation', 'warnings and limitations')} below."
    )
    meaning = (
        "In-sample is what the fit leaves in the maps it was fitted to. Held-out is what it leaves in maps that had "
        "no part in it: the figure to rely on. Re-measured is what a map showed after a command of this calibration "
        "was applied. All lengths are surface sag, piston and tilt removed."
    )
    return Section(
        "Summary", [kind, meaning, counts[0].upper() + counts[1:]], [Table("Key figures", ("figure", "value"), rows)]
    )


def provenance(calibration: Calibration) -> Section:
    """What was measured, when, with what."""
    maps, fit = calibration.maps, calibration.fit
    first, last = int(maps.stamp_ns.min()), int(maps.stamp_ns.max())
    wavelength = f"{calibration.wavelength * NM:.2f} nm" if calibration.wavelength > 0.0 else "not stated by the maps"
    kinds = Counter(itertools.compress(maps.kind, maps.has_map))
    rows = [
        ("calibration", calibration.id),
        ("mirror", f"{calibration.mirror_name}, serial {calibration.mirror_serial}"),
        ("actuators", str(fit.actuators)),
        ("calibrated aperture", f"{2e3 * calibration.aperture_radius:.3f} mm diameter"),
        ("wavelength", wavelength),
        ("stored", utc(calibration.created_ns)),
        ("first map", utc(first)),
        ("last map", f"{utc(last)}, {(last - first) / 60e9:.1f} min later"),
        ("maps", ", ".join(f"{count} {kind}" for kind, count in kinds.items())),
        ("maps in the fit", f"{int(fit.used.sum())} of {maps.has_map.sum()}"),
        ("method", fit.method),
        ("fitted", f"{maps.terms} Zernike coefficients (Born & Wolf) and sag at {maps.points.x.size} points"),
        ("software", f"dm_calibration {calibration.software_version}"),
        ("note", calibration.note or "none"),
    ]
    shapes = [(name, target.strip()) for name, _, target in (text.partition(":") for text in calibration.targets)]
    tables = [Table("Provenance", ("item", "value"), rows, textual=True)]
    if shapes:
        title = "Shapes that were solved on an influence function"
        tables.append(Table(title, ("surface", "aim"), shapes, textual=True))
    text = (
        "The calibration file holds everything this page is made of: signals, coefficients and sag of every map, names "
        "and full SHA-256 of the map files, and the result."
    )
    return Section("What was measured, when and with what", [text], tables)


def cautions(calibration: Calibration) -> Section:
    """Poke check, limitations, dropped maps."""
    findings = [text.removeprefix(POKE_CHECK) for text in calibration.limitations if text.startswith(POKE_CHECK)]
    others = [text for text in calibration.limitations if not text.startswith(POKE_CHECK)]
    checked = [f"Poke check. {finding}" for finding in findings]
    if not findings:
        checked = ["Poke check: the responses lie where the configured layout puts the actuators."]
    rejected = calibration.maps.rejected(calibration.fit.reasons)
    never = [(label, reason.strip()) for label, _, reason in (entry.partition(":") for entry in calibration.dropped)]
    table = Table("Maps that are not in the fit", ("map", "reason"), [*rejected, *never], textual=True)
    return Section("Warnings and known limitations", [*checked, *others], [table] if table.rows else [])


def every_map(calibration: Calibration) -> Section:
    """One row per map."""
    maps, fit = calibration.maps, calibration.fit
    seconds = (maps.stamp_ns - maps.stamp_ns.min()) * 1e-9
    rows = [
        (
            label,
            maps.kind[i],
            f"{seconds[i]:.1f}",
            f"{fit.map_residual[i] * NM:.2f}" if fit.used[i] else "dropped",
            f"{maps.residual_rms[i] * NM:.2f}" if np.isfinite(maps.residual_rms[i]) else "no map",
            f"{100 * maps.valid_fraction[i]:.1f}",
        )
        for i, label in enumerate(maps.label)
    ]
    text = (
        "Residual: rms sag that the fit leaves. Beyond 21 terms: what the Zernike terms leave of the map itself, "
        "print-through and noise."
    )
    header = ("map", "kind", "time, s", "residual, nm", "beyond 21 terms, nm", "valid, %")
    return Section("Every map", [text], [Table("Maps in the order measured", header, rows)])


def files(calibration: Calibration, file: str, sha256: str) -> Section:
    """Names and hashes of the calibration's own `file` and of its map files."""
    maps = calibration.maps
    rows = [
        (label, PurePath(name).name, digest[:SHA_SHOWN])
        for label, name, digest in zip(maps.label, maps.file, maps.sha256, strict=True)
        if name
    ]
    folders = sorted({str(PurePath(name).parent) for name in maps.file if name})
    lay = f"Map files lay in {', '.join(folders)}." if folders else "The maps came without files."
    table = Table("Map files", ("map", "file", "SHA-256"), rows, textual=True)
    return Section("Files", [f"This report was made of {file}, SHA-256 {sha256}.", lay], [table] if rows else [])
