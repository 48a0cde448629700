"""The connected mirror, the stored calibrations, and the calibration in use."""

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from dm_calibration.calibration import Calibration
from dm_calibration.calibrator import Provenance
from dm_calibration.store.calibration_store import CalibrationStore, raw_hash
from dm_common.atomic_write import StoreError
from dm_common.errors import EXPECTED, NO_CALIBRATION, ErrorCode, Refusal, UnknownNameError
from dm_common.figures import in_nanometres
from dm_common.mirror import Mirror, mismatch
from dm_common.recipes import RecipeBook, RecipeError

#: Factor by which the promise of a calibration may exceed that of the one it replaces without a warning.
CLEARLY_WORSE = 2.0


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Whether `condition` holds now or becomes true within `timeout_s` s of wall time."""
    deadline = time.monotonic() + timeout_s
    while not (held := condition()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return held


class CalibrationManager:
    """Shared by the topics, services and the action of the node; every method is thread-safe.

    Attributes:
        mirror: as the driver describes it; None before the driver has done so.
        driver_facts: the driver's wiring and electronics, see :func:`~.calibration_messages.driver_facts`.
        in_use: the calibration in use; None = there is none.
    """

    def __init__(
        self,
        store: CalibrationStore,
        aperture_tolerance: Callable[[], float],
        now_ns: Callable[[], int],
        publish: Callable[[Calibration | None, Path | None], None],
        resting: Callable[[], str] = lambda: "",
    ) -> None:
        """Nothing is in use at first.

        Args:
            publish: called with the calibration in use and its file at every change.
            resting: returns the reason why no other calibration may be put into use now; "" = one may.
        """
        self.store = store
        self._aperture_tolerance, self._now_ns, self._publish = aperture_tolerance, now_ns, publish
        self._resting = resting
        self._lock = threading.RLock()
        # Held while a stored calibration is changed, so that no change gets lost; writing may take a while.
        self._changing = threading.Lock()
        self.mirror: Mirror | None = None
        self.driver_facts: Mapping[str, Any] = {}
        self.in_use: Calibration | None = None

    def known_mirror(self, wait_s: float = 0.0) -> Mirror:
        """The mirror; a worker thread may wait up to `wait_s` for a driver that is still starting.

        Raises:
            Refusal: the mirror is not known yet.
        """
        wait_until(lambda: self.mirror is not None, wait_s)
        if (mirror := self.mirror) is None:
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "no mirror_info yet: is pdm_driver running and configured?")
        return mirror

    def set_mirror(self, mirror: Mirror) -> str:
        """Set the mirror. Returns why the calibration in use was withdrawn; "" = it was not."""
        with self._lock:
            self.mirror, before = mirror, self.in_use
            if before is None or not (wrong := self.mismatch(before)):
                return ""
            self.use(None)
            return f"calibration {before.id} withdrawn: {wrong}"

    def mismatch(self, calibration: Calibration) -> str:
        """Why `calibration` does not belong to the mirror; "" = it does, or no mirror is known yet."""
        if (mirror := self.mirror) is None:
            return ""
        of = calibration
        return mismatch(mirror, of.mirror_serial, of.fit.actuators, of.aperture_radius, self._aperture_tolerance())

    def check_fits(self, calibration: Calibration) -> None:
        """Raise Refusal unless `calibration` belongs to the mirror."""
        self.known_mirror()
        if wrong := self.mismatch(calibration):
            raise Refusal(ErrorCode.CALIBRATION_MISMATCH, f"calibration {calibration.id}: {wrong}")

    def use(self, calibration: Calibration | None) -> str:
        """Use `calibration`, which is in the store, from now on.

        Raises Refusal if the node is no longer active, or the mirror is another one.

        Returns a warning if the promise is clearly worse than that of its predecessor, or if the choice could not be
        stored for the next start; "" = neither.
        """
        with self._lock:
            before = self.in_use
            if calibration is not None and (reason := self._resting()):
                raise Refusal(ErrorCode.NODE_INACTIVE, f"{calibration.id} is stored, but not used: {reason}")
            if calibration is not None and (wrong := self.mismatch(calibration)):
                raise Refusal(ErrorCode.CALIBRATION_MISMATCH, f"{calibration.id} is stored, but not used: {wrong}")
            self._put(calibration)
        warnings = []
        if calibration is not None:
            try:
                self.store.note_in_use(calibration)
            except StoreError as error:
                warnings.append(f"warning: {error}")
            if before is not None and calibration.promise > CLEARLY_WORSE * before.promise:
                warnings.append(
                    f"warning: it promises {in_nanometres(calibration.promise)}, clearly worse than "
                    f"{in_nanometres(before.promise)} of {before.id}, which it replaces (load_calibration brings that "
                    "back)"
                )
        return "; ".join(warnings)

    def _put(self, calibration: Calibration | None) -> None:
        """Put `calibration` into use; the lock must be held."""
        self.in_use, file = calibration, None
        if calibration is not None:
            with suppress(UnknownNameError):  # the file was removed meanwhile; the calibration stays in use
                file = self.store.find(calibration.id)
        self._publish(calibration, file)

    def publish_again(self) -> None:
        """Publish the calibration in use anew."""
        with self._lock:
            if self.in_use is not None:
                self._put(self.in_use)

    def publish_none(self) -> None:
        """Publish that there is no calibration, unless one has been put into use meanwhile."""
        with self._lock:
            if self.in_use is None:
                self._put(None)

    def load(self, name: str) -> tuple[Calibration, str]:
        """Load by id or file (empty = the newest that fits), and use it. Returns it and the warning of `use`.

        Raises:
            Refusal: no mirror, or the calibration belongs to another one; the one in use stays.
            UnknownNameError, CalibrationFileError: see the store.
        """
        mirror = self.known_mirror()
        if name:
            calibration = self.store.load(name)
            self.check_fits(calibration)
            return calibration, self.use(calibration)
        for entry in self.store.entries():
            if entry.calibration and not self.mismatch(entry.calibration):
                return entry.calibration, self.use(entry.calibration)
        raise Refusal(ErrorCode.NOT_CALIBRATED, f"no calibration in {self.store.folder} fits mirror {mirror.serial!r}")

    def load_last(self) -> tuple[Calibration, str]:
        """Use the calibration that the mirror used last; if that is not known or fails, the newest that fits.

        Returns the calibration, and why it is not the one used last, else the warning of `use`; "" = neither.

        Raises:
            Refusal: no mirror, the node is inactive, or no calibration fits.
        """
        last, reason = self.store.last_in_use(self.known_mirror().serial), ""
        if last and not self._resting():
            try:
                return self.load(last)
            except EXPECTED as error:
                reason = f"the calibration last in use, {last}, cannot be loaded: {error}"
        calibration, warning = self.load("")
        return calibration, reason or warning

    def named(self, name: str = "") -> Calibration:
        """A stored calibration by id or file; empty = the one in use. Raises Refusal if there is none."""
        calibration = self.store.load(name) if name else self.in_use
        if calibration is None:
            raise Refusal(ErrorCode.NOT_CALIBRATED, NO_CALIBRATION)
        return calibration

    def _checked_in_use(self, calibration_id: str) -> Calibration:
        calibration = self.named()
        if calibration.id != calibration_id:
            raise Refusal(
                ErrorCode.CALIBRATION_MISMATCH,
                f"recipes.calibration_id = {calibration_id!r}: the calibration in use is {calibration.id!r}",
            )
        return calibration

    def add_recipes(self, calibration_id: str, book: RecipeBook) -> Calibration:
        """Add recipes to the calibration in use, from which they were built; those of the same shape are replaced.

        The calibration's file is changed as well, and the calibration is published again.

        Raises:
            Refusal: another or no calibration is in use, or the recipes have another number of actuators.
            RecipeError: no recipes, or recipes made under another condition.
            StoreError: it could not be written; file and calibration in use are unchanged.
        """
        if not book.recipes:
            raise RecipeError("recipes is empty: must hold at least one")
        with self._changing:
            before = self._checked_in_use(calibration_id)
            count, has = len(book.recipes[0].effective), before.fit.actuators
            if count != has:
                text = f"effective has {count} values: calibration {before.id} has {has} actuators"
                raise Refusal(ErrorCode.INVALID_LENGTH, text)
            # Those in the file: another node that shares the folder may have added some.
            after = replace(before, recipes=self.store.load(before.id).recipes.merged(book))
            self.store.replace(after)
            with self._lock:
                self._checked_in_use(calibration_id)
                self._put(after)
            return after

    def keep(self, calibration: Calibration) -> tuple[Path, Calibration]:
        """Store `calibration`, unless that was already done; returns the file, and the calibration read back from it.

        Raises:
            StoreError: it cannot be written, or the maps read back differ from those measured.
            CalibrationFileError: the file read back is damaged.
        """
        try:
            file = self.store.find(calibration.id)
        except UnknownNameError:
            file = self.store.save(calibration)
        stored = self.store.load(calibration.id)
        if raw_hash(stored) != raw_hash(calibration):
            raise StoreError(f"calibration {calibration.id}: the maps in {file} differ from those measured")
        return file, stored

    def provenance(self, name: str, serial: str, note: str) -> Provenance:
        """A new id and the current time for a calibration of mirror `name`, `serial`."""
        now = self._now_ns()
        return Provenance(self.store.new_id(name, serial, now), now, note.replace("\0", ""))
