"""The calibration in use, kept true by maps that arrive later: which are taken, what they change, what is stored.

The calibration's own file is never touched. What later maps have shown stands beside it, in ``<id>.updates.hdf5``.
"""

import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import same_points
from dm_calibration.procedure.applied_history import MapNotUsableError, SettledState
from dm_calibration.procedure.map_acquisition import WAVELENGTH_TOLERANCE
from dm_calibration.recalibration.check_log import SUFFIX as LOG_SUFFIX
from dm_calibration.recalibration.check_log import Check, append_check
from dm_calibration.recalibration.displaced import described, worst_elsewhere
from dm_calibration.recalibration.drift import Comparison, Drift, DriftRates, Taken
from dm_calibration.recalibration.drift_filter import DriftFilter
from dm_calibration.recalibration.update_storage import UpdatesFileError, basis_hash, read_updates, write_updates
from dm_common.atomic_write import storing
from dm_common.measurement import Measurement
from dm_common.mirror import APERTURE_TOLERANCE
from dm_common.values import live_parameter, real, whole

#: Maps of one unmoved mirror within this time share the error of the hysteresis model, s.
REPEAT_S = 3600.0
#: Moves that are nearer to each other in time are one, s.
SAME_MOVE_S = 0.2
SUFFIX = ".updates.hdf5"


@dataclass(frozen=True)
class UpdateOptions:
    """What is taken, and how far it may change the calibration.

    Attributes:
        valid_fraction_min: least share of valid pixels.
        aperture_tolerance: largest relative deviation of a map's aperture radius from the calibration's.
        signal_sigma: standard deviation of an effective signal where no hysteresis model is identified, normalised.
    """

    surprise_max: float = live_parameter(
        real(3.0, 1.0, 100.0),
        "A map that differs from its prediction by more than this times the expected difference is not taken.",
    )
    surprises_max: int = live_parameter(
        whole(3, 1, 1000), "Maps in a row that differ so much after which the mirror counts as changed."
    )
    valid_fraction_min: float = 0.5
    aperture_tolerance: float = APERTURE_TOLERANCE
    signal_sigma: float = 0.05
    rates: DriftRates = field(default_factory=DriftRates)


@dataclass(frozen=True)
class Verdict:
    """What became of a map.

    Attributes:
        accepted: it agreed well enough to be taken in.
        reason: why not, or what it showed.
    """

    accepted: bool
    reason: str
    comparison: Comparison


class RecalibrationManager:
    """Updates of the calibration in use; every method may be called from any thread.

    Args:
        options: asked for at every map; its rates and signal_sigma at every new calibration.
    """

    def __init__(self, folder: Path, options: Callable[[], UpdateOptions]) -> None:
        self.folder, self._options = folder, options
        self._lock = threading.RLock()
        self._calibration: Calibration | None = None
        self._filter: DriftFilter | None = None
        self._updates: Drift | None = None
        self._basis = ""
        self._forget_repeats()

    def _forget_repeats(self) -> None:
        self._repeat, self._since, self._first_ns = 0, float("nan"), 0
        self._disagreement = 0.0

    @property
    def calibration(self) -> Calibration | None:
        """The calibration in use, as it was made."""
        with self._lock:
            return self._calibration

    @property
    def updates(self) -> Drift | None:
        """What maps have shown since; None without a calibration."""
        with self._lock:
            return self._updates

    @property
    def mirror_changed(self) -> bool:
        """Whether so many maps in a row disagreed that the calibration is in doubt."""
        with self._lock:
            return self._updates is not None and self._updates.surprising >= self._options().surprises_max

    @property
    def disagreement(self) -> float:
        """Largest error (m) that maps have shown since one agreed, or that actuators they show make elsewhere."""
        with self._lock:
            return self._disagreement

    @property
    def doubts(self) -> list[str]:
        """Sentences on why the calibration may not hold any more, or only in part."""
        with self._lock:
            doubts = []
            if self._updates is not None and self.mirror_changed:
                doubts.append(
                    f"The last {self._updates.surprising} maps disagree with this calibration: the mirror has changed, "
                    "calibrate again."
                )
            if self._updates is not None and self._updates.given_up:
                doubts.append(f"{self._updates.given_up}.")
            return doubts

    def begin(self, calibration: Calibration | None) -> str:
        """Keep `calibration` true from now on, with what is stored of it. Returns a remark on damaged files, "" = none.

        Raises:
            ValueError: the calibration's maps make no sense.
        """
        with self._lock:
            self._calibration, self._filter, self._updates = calibration, None, None
            self._forget_repeats()
            if calibration is None:
                return ""
            options = self._options()
            self._basis = basis_hash(calibration)
            self._filter = DriftFilter(
                calibration.fit, calibration.maps, calibration.hysteresis, options.signal_sigma, options.rates
            )
            self._updates = fresh = self._filter.start(calibration.stamp_ns)
            file = self._file(calibration.id)
            try:
                self._updates = read_updates(file, calibration.id, self._basis, fresh) or fresh
            except UpdatesFileError as error:
                return f"updates of {calibration.id} are ignored: {error}"
            return ""

    def changed_fit(self, temperature: float = math.nan) -> InfluenceFit | None:
        """The influence function as maps have found it, at `temperature` (degC); None without a calibration."""
        with self._lock:
            if self._filter is None or self._updates is None:
                return None
            return self._filter.changed(self._updates, temperature)

    def warm_error(self, temperature: float) -> float:
        """95 % bound of what `temperature` (degC) may change of a coefficient, m; 0 where it is known."""
        with self._lock:
            if self._filter is None or self._updates is None or math.isfinite(temperature):
                return 0.0
            return self._filter.warm_error(self._updates)

    def take(
        self, measured: Measurement, settled: SettledState, dry_run: bool = False, without: Sequence[int] = ()
    ) -> Verdict:
        """Compare a map of the mirror at `settled` with the calibration, and take it in when it agrees.

        Args:
            without: indices of actuators that do not move any more: from now on without effect, standing where the
                map shows them.

        Raises:
            MapNotUsableError: there is no calibration, or the map cannot be compared with it, or does not show that
                the actuators fail.
            StoreError: the update could not be stored; nothing has changed.
        """
        with self._lock:
            calibration, updates, drift_filter = self._calibration, self._updates, self._filter
            if calibration is None or updates is None or drift_filter is None:
                raise MapNotUsableError("no calibration is in use")
            options = self._options()
            check_map(measured, calibration, options)
            if settled.effective.shape != (calibration.fit.actuators,):
                raise MapNotUsableError(
                    f"{settled.effective.size} signals stand at the mirror, the calibration has "
                    f"{calibration.fit.actuators}"
                )
            repeat = self._repeats(measured.stamp_ns, settled)
            where = settled.effective, measured.stamp_ns, repeat, measured.temperature
            taken = Taken(measured.coefficients, measured.sag, *where)
            if without:
                updates = drift_filter.give_up(updates, list(without), taken)
            comparison = drift_filter.compare(updates, taken)
            accepted = comparison.surprise <= options.surprise_max
            reason = f"differs by {comparison.surprise:.1f} times what is to be expected"
            found = comparison.displaced, comparison.probability, updates.standing(settled.effective)
            worst = max(comparison.max_zernike, worst_elsewhere(*found, calibration.fit.influence_zernike))
            if not accepted:
                reason += f", more than {options.surprise_max:g}: "
                reason += described(*found)
            elif without:
                reason = f"{updates.given_up}; the map then {reason}"
            if dry_run:
                return Verdict(accepted, reason, comparison)
            before = self._updates or updates
            changed = comparison.updated if accepted else replace(before, surprising=before.surprising + 1)
            with storing(f"the update of {calibration.id} was not stored in {self.folder}"):
                write_updates(self._file(calibration.id), calibration.id, self._basis, changed)
            self._updates = changed
            with suppress(OSError):  # the update itself is stored
                shown = Check.of(measured.stamp_ns, accepted, comparison, changed)
                append_check(self._file(calibration.id, LOG_SUFFIX), shown)
            self._disagreement = 0.0 if accepted else max(self._disagreement, worst)
            if accepted:
                if not repeat:
                    self._since, self._first_ns = settled.since, measured.stamp_ns
                self._repeat = repeat + 1
            elif self.mirror_changed:
                reason = f"{reason}; {changed.surprising} maps in a row did: the mirror has changed: calibrate again"
            return Verdict(accepted, reason, comparison)

    def forget(self) -> None:
        """Drop all updates of the calibration in use.

        Raises:
            MapNotUsableError: no calibration is in use.
            StoreError: the file could not be removed; nothing has changed.
        """
        with self._lock:
            if self._calibration is None or self._filter is None:
                raise MapNotUsableError("no calibration is in use")
            with storing(f"updates of {self._calibration.id} were not removed"):
                self._file(self._calibration.id).unlink(missing_ok=True)
            self._updates = self._filter.start(self._calibration.stamp_ns)
            self._forget_repeats()

    def _repeats(self, stamp_ns: int, settled: SettledState) -> int:
        # Where it is held against creep, the first correction that kept this very shape is not always the same one.
        same = abs(settled.since - self._since) < SAME_MOVE_S and 1e-9 * (stamp_ns - self._first_ns) < REPEAT_S
        return self._repeat if same else 0

    def _file(self, identifier: str, suffix: str = SUFFIX) -> Path:
        return self.folder / f"{identifier}{suffix}"


def check_map(measured: Measurement, calibration: Calibration, options: UpdateOptions) -> None:
    """Refuse a map that cannot be compared with `calibration`.

    Raises:
        MapNotUsableError: naming what differs, its value and what is allowed.
    """
    terms = calibration.maps.terms
    if measured.coefficients.shape != (terms,):
        raise MapNotUsableError(f"{measured.coefficients.size} Zernike terms, the calibration has {terms}")
    if not np.isfinite(measured.coefficients).all():
        raise MapNotUsableError("coefficients: hold values that are not finite")
    if not same_points(measured.points, calibration.fit.points):
        raise MapNotUsableError(
            "sampled at other points than the calibration, which another interferometer node or version was used for: "
            "calibrate anew"
        )
    if not abs(measured.wavelength - calibration.wavelength) <= WAVELENGTH_TOLERANCE * calibration.wavelength:
        raise MapNotUsableError(
            f"wavelength {measured.wavelength * 1e9:.3f} nm, the calibration's is "
            f"{calibration.wavelength * 1e9:.3f} nm (0 = not known)"
        )
    if measured.reference_surface != calibration.reference_surface:
        raise MapNotUsableError(
            f"reference_surface {measured.reference_surface or 'none'}, the calibration was made with "
            f"{calibration.reference_surface or 'none'}"
        )
    radius, tolerance = calibration.aperture_radius, options.aperture_tolerance
    if measured.radius and not abs(measured.radius - radius) <= tolerance * radius:
        raise MapNotUsableError(
            f"aperture radius {measured.radius * 1e3:.3f} mm, the calibration's is {radius * 1e3:.3f} mm "
            f"+-{tolerance:.1%}"
        )
    if not measured.valid_fraction >= options.valid_fraction_min:
        raise MapNotUsableError(
            f"{measured.valid_fraction:.1%} of the pixels are valid: must be at least {options.valid_fraction_min:.1%}"
        )
    seen = float(np.isfinite(measured.sag) @ calibration.fit.points.weight)
    if not seen >= options.valid_fraction_min:
        raise MapNotUsableError(
            f"{seen:.1%} of the sampled area has data: must be at least {options.valid_fraction_min:.1%}"
        )
    if measured.stamp_ns <= calibration.stamp_ns:
        raise MapNotUsableError("measured before the calibration was finished, by its stamp")
