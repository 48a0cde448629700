"""Updates of the calibration in use by later maps: which maps are used, what they change, and storage.

The calibration's own file is never changed. Updates are stored beside it, in ``<id>.updates.hdf5``.
"""

import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.influence.maps import same_points
from dm_calibration.procedure.applied_history import MapNotUsableError, SettledState
from dm_calibration.procedure.map_comparison import other_aperture, other_setup
from dm_calibration.recalibration.check_log import SUFFIX as LOG_SUFFIX
from dm_calibration.recalibration.check_log import Check, append_check
from dm_calibration.recalibration.displaced import (
    described,
    failing_from,
    noticed,
    noticed_error,
    shown_at,
    without_response,
    worst_other_error,
)
from dm_calibration.recalibration.drift import Comparison, Drift, UpdateOptions
from dm_calibration.recalibration.drift_filter import DriftFilter
from dm_calibration.recalibration.update_storage import UpdatesFileError, read_updates, write_updates
from dm_common.atomic_write import storing
from dm_common.errors import NO_CALIBRATION, ErrorCode, Refusal, beside
from dm_common.measurement import Measurement

#: Time within which all maps of a mirror that has not moved share the error of the hysteresis model, s.
REPEAT_S = 3600.0
#: Times of moves that differ by less than this, s, belong to the same move.
SAME_MOVE_S = 0.2
#: Least share by which bounds are wider for drift that is worth a sentence.
WIDER_MENTIONED = 0.05
SUFFIX = ".updates.hdf5"


@dataclass(frozen=True)
class Verdict:
    """Result of the comparison of a map.

    Attributes:
        accepted: it agreed well enough to update the calibration.
        reason: why not, or what the map showed.
    """

    accepted: bool
    reason: str
    comparison: Comparison


@dataclass(frozen=True, eq=False)
class InUse:
    """The calibration in use and its drift, as estimated from later maps. Never changed in place.

    Attributes:
        repeats: number of maps of the present shape, which the mirror has had since `since` (s); the first of them was
            taken at `first_ns`.
    """

    calibration: Calibration
    filter: DriftFilter
    drift: Drift
    repeats: int = 0
    since: float = float("nan")
    first_ns: int = 0


class RecalibrationManager:
    """Updates of the calibration in use; every method may be called from any thread.

    Args:
        options: called for every map.

    Attributes:
        in_use: None without a calibration; replaced as a whole.
        ignored: why the stored updates are not used; "" = they are.
    """

    def __init__(self, folder: Path, options: Callable[[], UpdateOptions]) -> None:
        self.folder, self._options = folder, options
        self._lock = threading.RLock()
        self.in_use: InUse | None = None
        self.ignored = ""

    @property
    def mirror_changed(self) -> bool:
        """Whether so many maps in a row disagreed that the calibration is in doubt."""
        kept = self.in_use
        return kept is not None and kept.drift.surprising >= self._options().surprises_max

    @property
    def doubts(self) -> list[str]:
        """Sentences on why the calibration may no longer hold, or only in part."""
        doubts, kept = [], self.in_use
        if kept is not None and self.mirror_changed:
            doubts.append(
                f"The last {kept.drift.surprising} maps disagree with this calibration: the mirror has changed, "
                "calibrate again."
            )
        if kept is not None and kept.drift.given_up:
            doubts.append(f"{kept.drift.given_up}.")
        if self.ignored:
            doubts.append(f"Corrections by earlier maps are missing: {self.ignored}.")
        return doubts

    @property
    def widened(self) -> list[str]:
        """Sentences if maps widen the bounds but leave no doubt of the calibration."""
        if (kept := self.in_use) is None:
            return []
        drift, sentences = kept.drift, list[str]()
        if (wider := math.sqrt(drift.excess) - 1.0) >= WIDER_MENTIONED:
            sentences.append(
                "The last maps differ by more than expected, as by drift faster than updates.gain_rate and "
                f"updates.figure_rate: bounds are {wider:.0%} wider until they do not."
            )
        if not drift.surprising and drift.disagreement:
            sentences.append(
                "A map shows an actuator that may begin to fail, or moves again: bounds are wider until one in which "
                "it would show does not."
            )
        if 0 < drift.surprising < self._options().surprises_max:
            last = "map disagrees" if drift.surprising == 1 else f"{drift.surprising} maps disagree"
            sentences.append(f"The last {last} with this calibration: bounds are wider until one agrees.")
        return sentences

    def begin(self, calibration: Calibration | None) -> str:
        """Update `calibration` from now on, beginning with its stored updates. Returns why those are not used, or "".

        Raises:
            ValueError: the time stamps of the calibration's maps run backwards.
        """
        with self._lock:
            self.in_use, self.ignored = None, ""
            if calibration is None:
                return ""
            drift_filter = DriftFilter(calibration, self._options())
            drift = drift_filter.start(calibration.stamp_ns)
            try:
                drift = read_updates(self._file(calibration.id), calibration, drift) or drift
            except UpdatesFileError as error:
                self.ignored = f"updates of {calibration.id} are ignored: {error}"
            self.in_use = InUse(calibration, drift_filter, drift)
            return self.ignored

    def take(
        self,
        measured: Measurement,
        settled: SettledState,
        dry_run: bool = False,
        without: Sequence[int] = (),
        now_ns: float = math.inf,
    ) -> Verdict:
        """Compare a map of the mirror in the state `settled` with the calibration, and update that if they agree.

        Args:
            without: indices of actuators that no longer move; from now on they have no effect and stand where the map
                shows them.
            now_ns: earlier maps dated after it are of before the clock was set back, and count as taken now.

        Raises:
            Refusal: no calibration is in use.
            MapNotUsableError: the map cannot be compared with it, or does not show that the actuators fail.
            StoreError: the update could not be stored; nothing has changed.
        """
        with self._lock:
            kept, options = self.kept(), self._options()
            calibration, before = kept.calibration, kept.drift
            check_map(measured, calibration, options)
            stamp, checked = (int(min(time, now_ns)) for time in (before.stamp_ns, before.checked_ns))
            updates = all_in_use = replace(before, stamp_ns=stamp, checked_ns=checked)
            if settled.effective.shape != (calibration.fit.actuators,):
                raise MapNotUsableError(
                    f"the mirror has {settled.effective.size} signals, the calibration {calibration.fit.actuators} "
                    "actuators"
                )
            repeat = _repeats(kept, measured.stamp_ns, settled)
            if without:
                updates = kept.filter.give_up(updates, sorted(set(without)), measured, settled.effective, repeat)
            comparison = kept.filter.compare(updates, measured, settled.effective, repeat)
            accepted = comparison.surprise <= options.surprise_max
            if without and not accepted:  # they stay in use
                updates = all_in_use
                comparison = kept.filter.compare(updates, measured, settled.effective, repeat)
            reason = f"differs from the prediction by {comparison.surprise:.1f} times the expected difference"
            found = comparison.displaced, updates.reached(settled.effective)
            causes = described(*found, np.isfinite(kept.drift.stuck), without_response(calibration))
            if not accepted:
                reason += f", more than {options.surprise_max:g}: {causes}"
            elif any(map(noticed, comparison.displaced.values())):
                reason += f"; {causes}"
            if accepted and without:
                reason = f"{updates.given_up}; the map then {reason}"
            if dry_run:
                return Verdict(accepted, reason, comparison)
            if accepted:
                begins = noticed_error(comparison.displaced, calibration.fit.influence_zernike)
                shown = shown_at(settled.effective, updates)
                failing = failing_from(*found, updates, shown)
                if np.isfinite(updates.failing[~shown]).any():  # this map could not show what earlier ones did
                    begins = max(begins, updates.disagreement)
                changed = replace(comparison.updated, disagreement=begins, failing=failing)
                kept = replace(kept, repeats=repeat + 1)
                if not repeat:
                    kept = replace(kept, since=settled.since, first_ns=measured.stamp_ns)
            else:
                other_error = worst_other_error(*found, calibration.fit.influence_zernike)
                worst = max(kept.drift.disagreement, comparison.max_zernike, other_error)
                failing = failing_from(*found, kept.drift, np.zeros(len(kept.drift.stuck), dtype=np.bool_))
                surprising = kept.drift.surprising + 1
                changed = replace(kept.drift, surprising=surprising, disagreement=worst, failing=failing)
            with storing(f"the update of {calibration.id} was not stored in {self.folder}"):
                write_updates(self._file(calibration.id), calibration, changed)
            self.in_use, self.ignored = replace(kept, drift=changed), ""
            gain, actuator = changed.largest_gain
            departure = comparison.max_zernike, comparison.rms, comparison.surprise
            seconds = 1e-9 * measured.stamp_ns
            check = Check(seconds, int(accepted), *departure, gain, actuator + 1, changed.offset_rms)
            with suppress(OSError):  # the update itself is stored
                append_check(self._file(calibration.id, LOG_SUFFIX), check)
            if not accepted and self.mirror_changed:
                reason = (
                    f"{reason}; {changed.surprising} maps in a row disagree: the mirror has changed: calibrate again"
                )
            return Verdict(accepted, reason, comparison)

    def forget(self) -> None:
        """Drop all updates of the calibration in use.

        Raises:
            Refusal: no calibration is in use.
            StoreError: the file could not be removed; nothing has changed.
        """
        with self._lock:
            kept = self.kept()
            with storing(f"updates of {kept.calibration.id} were not removed"):
                self._file(kept.calibration.id).unlink(missing_ok=True)
            drift = kept.filter.start(kept.calibration.stamp_ns)
            self.in_use, self.ignored = InUse(kept.calibration, kept.filter, drift), ""

    def kept(self) -> InUse:
        """`in_use`, with a filter of the present options. Raises Refusal if no calibration is in use."""
        with self._lock:
            if (kept := self.in_use) is None:
                raise Refusal(ErrorCode.NOT_CALIBRATED, NO_CALIBRATION)
            if kept.filter.options != (options := self._options()):  # live parameters have changed
                kept = self.in_use = replace(kept, filter=DriftFilter(kept.calibration, options))
            return kept

    def _file(self, identifier: str, suffix: str = SUFFIX) -> Path:
        return self.folder / f"{identifier}{suffix}"


def _repeats(kept: InUse, stamp_ns: int, settled: SettledState) -> int:
    # While a shape is held against creep, different corrections may be found to have begun it.
    same = abs(settled.since - kept.since) < SAME_MOVE_S and 1e-9 * (stamp_ns - kept.first_ns) < REPEAT_S
    return kept.repeats if same else 0


def check_map(measured: Measurement, calibration: Calibration, options: UpdateOptions) -> None:
    """Refuse a map that cannot be compared with `calibration`.

    Raises:
        MapNotUsableError: the message names the property that differs, its value and what is allowed.
    """
    terms = calibration.maps.terms
    if measured.coefficients.shape != (terms,):
        raise MapNotUsableError(f"the map has {measured.coefficients.size} Zernike terms, the calibration {terms}")
    if not np.isfinite(measured.coefficients).all():
        raise MapNotUsableError("coefficients: hold values that are not finite")
    if not same_points(measured.points, calibration.fit.points):
        raise MapNotUsableError(
            "the map is sampled at other points than the calibration, made with another interferometer node or "
            "version: calibrate anew"
        )
    names = ["wavelength", "reference_surface"]
    if -1 not in (measured.system_error_subtracted, calibration.system_error_subtracted):
        names.append("system_error_subtracted")
    whose, tolerance = "the calibration's is", options.aperture_tolerance
    different = other_setup(measured, calibration, names, whose)
    different = different or other_aperture(measured, calibration.aperture_radius, tolerance, whose)
    if different:
        raise MapNotUsableError(f"{different}: set instrument and interferometer as they were, or calibrate anew")
    seen, least = float(np.isfinite(measured.sag) @ calibration.fit.points.weight), options.valid_fraction_min
    for share, text in ((measured.valid_fraction, "the pixels are valid"), (seen, "the sampled area has data")):
        if not share >= least:
            raise MapNotUsableError(f"{beside('.1%', share, least)} of {text}: must be at least {least:.1%}")
    if measured.stamp_ns <= calibration.stamp_ns:
        early = 1e-9 * (calibration.stamp_ns - measured.stamp_ns)
        raise MapNotUsableError(f"stamp {early:.3f} s before the calibration was finished: must be after that")
