"""Maps from elsewhere than a run of this suite: files, arrays or measurements, with their commands."""

import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.hysteresis.excitation import CHECK_SHARE
from dm_calibration.hysteresis.response_fit import TIME_MAX_S, between, check_signals, numbers, times_of
from dm_calibration.influence.maps import StepKind
from dm_calibration.map_files import NoValidPixelsError, SurfaceMap
from dm_calibration.optics.aperture import InsufficientDataError, MapRejectedError
from dm_calibration.procedure.map_comparison import check_comparable
from dm_calibration.procedure.outcome import MapTaken, Outcome, without_map
from dm_common import Bools, Floats
from dm_common.errors import MeasurementError
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.values import check_parameters

#: Sources of a calibration: a folder of map files, files, sag (M, height, width) in m, or measurements.
Maps = str | Path | Sequence[str | Path] | Sequence[Measurement] | Floats

#: Times below this, s (in Unix time, 1973), count from an arbitrary start.
UNIX_MIN_S = 1e8

#: Times further in the future than this, s, are no Unix times (LabVIEW counts from 1904); clocks differ by less.
AHEAD_MAX_S = 86400.0

#: Largest peak-to-valley sag of an array, m: a larger one indicates another unit.
SAG_MAX = 1e-3

#: Suffixes, in lower case, of the map files that are taken from a folder; upper case is accepted as well.
SUFFIXES = (".dat", ".datx", ".asc", ".xyz", ".fits", ".h5", ".4d")


def outcome_of(
    maps: Maps,
    commands: ArrayLike,
    times: ArrayLike | None,
    mirror: Mirror,
    settings: IngestSettings | None = None,
    hysteresis: bool = False,
    moved: ArrayLike | None = None,
) -> Outcome:
    """The maps in their order, as if a run had measured them; files of a folder are sorted by name, with digits as
    whole numbers.

    Args and errors as for :func:`~dm_calibration.calibrator.calibrate`, but `times` are Unix times. If neither `times`
    nor the files give the times of all maps, the maps are dated one second apart, the last one now.
    """
    settings = settings or IngestSettings(aperture_radius=mirror.working_radius)
    check_parameters(settings)
    measured, dropped = _measured(maps, settings, hysteresis)
    count = len(measured)
    signals = numbers(commands, "commands")
    if signals.shape != (count, mirror.actuators):
        raise ValueError(
            f"commands has the shape {signals.shape}: must be ({count}, {mirror.actuators}) finite numbers, a row for "
            "each map and a column for each actuator"
        )
    check_signals(signals)
    if times is not None:
        taken = zip(measured, times_of(times, count), strict=True)
        measured = [replace(one, stamp_ns=round(1e9 * at)) for one, at in taken]
    elif not all(one.stamp_ns for one in measured):
        if moved is not None:
            raise ValueError("moved: needs the times of the maps, which neither `times` nor the files state")
        if hysteresis:
            undated = next(number for number, one in enumerate(measured, 1) if not one.stamp_ns)
            raise ValueError(
                f"times: map {undated} has none, without which hysteresis cannot be separated from creep: give one in "
                "s for each map"
            )
        last = time.time_ns()
        measured = [replace(one, stamp_ns=last - (count - number) * 10**9) for number, one in enumerate(measured, 1)]
    if moved is not None:
        measured = _moved(measured, numbers(moved, "moved", "times in s"))
    if hysteresis:
        _check_times(measured, signals)
    outcome = Outcome()
    rest = np.where(np.ptp(signals, axis=0) > 0.0, mirror.rest, signals[0])  # actuators that never move rest there
    steps = np.cumsum(np.abs(np.diff(signals, axis=0, prepend=signals[:1])).any(axis=1))
    kinds = _kinds(np.abs(signals - rest) > 1e-9, hysteresis)
    for number, (one, row, kind) in enumerate(zip(measured, signals, kinds, strict=True)):
        label = f"{number + 1} {Path(one.file).name}" if one.file else f"map {number + 1}"
        if number in dropped:
            outcome.dropped.append(f"{label}: {dropped[number]}")
            kind = StepKind.EXCITATION if kind == StepKind.REFERENCE else kind  # a reference needs a map
        try:
            check_comparable(one, outcome, mirror.working_radius)
        except MeasurementError as error:
            raise MeasurementError(error.error_code, f"{label}: {error}") from error
        if outcome.setup is None:
            outcome.take(one.setup)
            if hysteresis and kind != StepKind.REFERENCE and mirror.limits.middle:
                # No map shows the mirror after the degauss, at mid range: not 0 on a mirror driven in one direction.
                begin = {"kind": StepKind.REFERENCE, "step": -1, "signals": rest, "applied": rest}
                outcome.take(
                    without_map(one, label="degauss", stamp_ns=(one.moved_ns or one.stamp_ns) - 10**9, **begin)
                )
        one = replace(one, label=label, kind=kind, step=int(steps[number]), signals=row, applied=row)
        outcome.take(MapTaken(one))
    return outcome


def unix_times(times: ArrayLike, moved: ArrayLike | None) -> tuple[Floats, Floats | None]:
    """`times` (M,) and `moved` (M,), s, as Unix times; if they count from another start, the last map is dated now."""
    taken = numbers(times, "times", "times in s")
    shapes = None if moved is None else numbers(moved, "moved", "times in s")
    last = taken.max(initial=-np.inf)
    if time.time() + AHEAD_MAX_S < last < TIME_MAX_S:  # beyond that it is no number of s
        raise ValueError(
            f"times go up to {last:g} s, which is in the future: must count in s from 1970, or from the first map"
        )
    shift = time.time() - last if last < UNIX_MIN_S else 0.0
    return taken + shift, None if shapes is None else shapes + shift


def _moved(measured: Sequence[Measurement], moved: Floats) -> list[Measurement]:
    """The measurements with the times when the mirror took their shapes, (M,) s."""
    taken = np.array([1e-9 * one.stamp_ns for one in measured])
    moved = between(moved, taken)
    pairs = zip(measured, moved, strict=True)
    return [replace(one, moved_ns=min(round(1e9 * float(at)), one.stamp_ns)) for one, at in pairs]


def _check_times(measured: Sequence[Measurement], signals: Floats) -> None:
    """Raise ValueError if the times of maps do not separate hysteresis from creep."""
    stamps = np.array([one.stamp_ns for one in measured])
    if not np.ptp(stamps) and len(stamps) > 1:
        raise ValueError("times: all are equal, so hysteresis cannot be separated from creep")
    same = (np.diff(stamps) == 0) & np.diff(signals, axis=0).any(axis=1)
    if same.any():
        row = int(same.argmax()) + 1
        raise ValueError(
            f"times: maps {row} and {row + 1} have equal times but different commands; give `times` if the files "
            "state whole seconds"
        )


def _by_number(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Key that sorts names with their digits as whole numbers: m2 before m10."""
    parts = re.split(r"([0-9]+)", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name


def _measured(maps: Maps, settings: IngestSettings, gaps: bool) -> tuple[list[Measurement], dict[int, str]]:
    """One measurement per map; from files, with time and digest.

    Args:
        gaps: whether a map with too few data becomes a gap, which keeps its command in the actuators' history.

    Returns:
        The measurements, and the reason for each gap by its index.
    """
    if isinstance(maps, str | Path):
        folder = Path(maps)
        maps = sorted((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES), key=_by_number)
        if not maps:
            raise ValueError(f"{folder}: holds no map file ({', '.join(SUFFIXES)})")
    ingest, found, dropped = Ingest(), list[Measurement | None](), dict[int, str]()
    for number, one in enumerate(maps):
        try:
            found.append(one if isinstance(one, Measurement) else _of_map(one, number, ingest, settings))
        except (InsufficientDataError, NoValidPixelsError) as error:
            if not gaps:
                raise
            found.append(None)
            dropped[number] = str(error).removeprefix(f"map {number + 1}: ")
    last = next((one for one in found if one is not None), None)
    if last is None:
        raise InsufficientDataError(dropped[0]) if dropped else ValueError("maps is empty: must hold at least one")
    stamps = {number: one.stamp_ns for number, one in enumerate(found) if one is not None and one.stamp_ns} or {0: 0}
    # The time of a file without data is interpolated between the maps around it; 0 = no map on one side.
    interpolated = np.interp(range(len(found)), [*stamps], [*stamps.values()], left=0, right=0)
    measured = []
    for one, at in zip(found, interpolated, strict=True):
        last = without_map(last, stamp_ns=round(at)).record if one is None else one
        measured.append(last)
    return measured, dropped


def _of_map(one: str | Path | Floats, number: int, ingest: Ingest, settings: IngestSettings) -> Measurement:
    """The measurement from a file or an array (height, width), m; `number`: its index."""
    if isinstance(one, str | Path):
        surface, measured = ingest.read(Path(one), settings)
        # Not the modification time: for copies that is the time of copying.
        stamp = surface.time_stamp or 0.0  # in a damaged file NaN or absurd, and then not known
        known = 0.0 < stamp <= time.time() + AHEAD_MAX_S
        return replace(measured, stamp_ns=round(1e9 * stamp) if known else 0, sha256=surface.sha256)
    sag = numbers(one, f"map {number + 1}")
    if sag.ndim != 2:
        raise ValueError(f"a map has the shape {sag.shape}: must be (height, width), in m")
    seen = sag[np.isfinite(sag)]
    if seen.size and np.ptp(seen) > SAG_MAX:
        raise ValueError(
            f"map {number + 1}: its sag spans {np.ptp(seen):.3g}: must be in m, not um or nm, up to {SAG_MAX:g}"
        )
    try:
        return ingest.measure(SurfaceMap(sag, settings.wavelength, None, "array"), settings)[1]
    except (InsufficientDataError, MapRejectedError) as error:
        raise type(error)(f"map {number + 1}: {error}") from error


def _kinds(away: Bools, hysteresis: bool) -> list[StepKind]:
    """(M,) kinds that a run would have given the maps; `away` (M, N): which actuators are away from rest."""
    if hysteresis:
        tested = round((1.0 - CHECK_SHARE) * len(away))
        kinds = [StepKind.EXCITATION if number < tested else StepKind.CHECK for number in range(len(away))]
        if not away[0].any():
            kinds[0] = StepKind.REFERENCE
        return kinds
    return [{0: StepKind.REFERENCE, 1: StepKind.POKE}.get(int(count), StepKind.SURFACE) for count in away.sum(axis=1)]
