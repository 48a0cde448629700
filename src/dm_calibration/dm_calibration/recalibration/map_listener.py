"""Maps that arrive between calibrations: over the interferometer's topics, or measured for `update_calibration`."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from dm_msgs.msg import ActuatorState, SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.srv import Measure, UpdateCalibration

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_manager import CalibrationManager, wait_until
from dm_calibration.calibration_messages import put_updates
from dm_calibration.calibration_parameters import update_options
from dm_calibration.procedure.applied_history import AppliedHistory, MapNotUsableError
from dm_calibration.recalibration.temperature import TemperatureLog
from dm_calibration.recalibration.updates import RecalibrationManager, Verdict
from dm_calibration.requests import UPDATE_CALIBRATION
from dm_common.atomic_write import StoreError
from dm_common.errors import EXPECTED, ErrorCode, Refusal
from dm_common.measurement import Measurement
from dm_common.messages import applied_from, measurement_from, stamp_ns
from dm_common.ros import qos
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.lifecycle import OK, WARN, ManagedNode
from dm_common.ros.worker import WorkerService
from dm_common.values import fill_with_nan, wholes

#: Longest wait for a report of the driver after a map, s of wall time (it reports every 0.5 s).
REPORT_WAIT_S = 3.0
#: Least wall time between two messages on `calibration` that updates cause, s.
PUBLISH_PERIOD_S = 1.0
#: Bounds grow with the time without a map: they are published again after this time, s, and when it has grown so much.
AGED_S, AGED = 3600.0, 1.5
#: Number of maps kept that still lack a message, and of maps remembered so that none counts twice.
INCOMPLETE_KEPT, MAPS_KEPT = 8, 64


class MapListener:
    """Passes arriving maps to :class:`RecalibrationManager` and publishes the changes.

    Args:
        busy: whether a calibration is running; its maps are not taken.
    """

    def __init__(
        self,
        node: ManagedNode,
        values: Mapping[str, Any],
        manager: CalibrationManager,
        services: BenchServices,
        busy: Callable[[], bool],
    ) -> None:
        self._node, self._values = node, values
        self._manager, self._services, self._busy = manager, services, busy
        self._updates = RecalibrationManager(manager.store.folder, lambda: update_options(values))
        self.history = AppliedHistory()  # of this mirror; the node restarts it for another one
        self._followed: Any = None  # law and mid range
        self._turn = threading.Lock()  # one map at a time; held while measuring and judging
        self._exchange = threading.Lock()  # a map is compared under the law of its effective signals
        self._incomplete: dict[int, dict[str, Any]] = {}  # by the stamp that the messages of one map share
        self._compared: deque[Measurement] = deque(maxlen=MAPS_KEPT)
        self._taken, self._refused, self._last_refusal = 0, 0, ""
        self._dirty = self._was_stale = False
        self._published_at, self._published_age_s = float("-inf"), 0.0
        self._temperatures = TemperatureLog(node, lambda: values["temperature.silent_after"])
        services.temperature = self._temperatures.at
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="updates")
        node.create_subscription(ActuatorState, "actuator_state", self._on_state, qos.STATE)
        node.create_subscription(ZernikeCoefficients, "zernike", lambda m: self._on_part("zernike", m), qos.STATE)
        node.create_subscription(SurfaceSamples, "surface_samples", lambda m: self._on_part("samples", m), qos.STATE)
        node.create_subscription(SurfaceMapInfo, "surface_map_info", lambda m: self._on_part("info", m), qos.STATE)
        WorkerService(node, UpdateCalibration, "update_calibration", self._on_update, UPDATE_CALIBRATION)

    def stop(self) -> None:
        """Take no more maps."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def begin(self, calibration: Calibration | None) -> None:
        """Update `calibration` by maps from now on, and follow its hysteresis about the mirror's present mid range."""
        same = calibration is getattr(self._updates.in_use, "calibration", None)
        middle = float(mirror.rest[0]) if (mirror := self._manager.mirror) is not None else 0.0
        law = calibration.hysteresis.law if calibration is not None and calibration.hysteresis is not None else None
        if same and (law, middle) == self._followed:
            return
        with self._exchange:
            self._followed = law, middle
            self.history.follow(law, middle)
            if same:
                return
            self._updates.folder = self._manager.store.folder
            try:
                remark = self._updates.begin(calibration)
            except ValueError as error:  # use it nevertheless, without updates
                remark = f"calibration {calibration.id if calibration else ''} cannot be updated by maps: {error}"
        if remark:
            self._node.get_logger().warning(remark)

    def amend(self, message: CalibrationMsg) -> None:
        """Add the updates by later maps to the message of the calibration in use."""
        self._published_at, self._dirty = time.monotonic(), False  # first: maps may show more meanwhile
        self._published_age_s = self._age_s
        if (kept := self._updates.in_use) is not None:
            changed, error_max = self._updates.mirror_changed, self._values["calibrated_error_max"]
            temperature, age_s = self._temperatures.published(), self._published_age_s
            put_updates(message, kept, temperature, self._doubts(), changed, error_max, age_s)

    @property
    def recipes_in_doubt(self) -> bool:
        """Whether recipes may no longer hold: some actuators are given up, or maps disagree."""
        kept = self._updates.in_use
        return kept is not None and bool(kept.drift.given_up or kept.drift.surprising)

    def _doubts(self) -> list[str]:
        """Sentences on why the calibration may no longer hold."""
        doubts = [*self._updates.doubts, *self._updates.widened]
        if self._stale:
            doubts.append(f"Stale: no map has agreed with this calibration for {self._age_s / 86400.0:.1f} days.")
        if (kept := self._updates.in_use) and (error := kept.filter.warm_error(kept.drift, self._temperatures.now())):
            doubts.append(
                f"No message on the topic temperature: up to {1e9 * error:.1f} nm of thermal drift are not corrected."
            )
        return doubts

    @property
    def _age_s(self) -> float:
        """Time since a map last agreed with the calibration, or since it was made, s."""
        if (kept := self._updates.in_use) is None:
            return 0.0
        now = int(self._node.get_clock().now().nanoseconds)
        return max(0.0, 1e-9 * (now - max(kept.calibration.stamp_ns, kept.drift.checked_ns)))

    @property
    def _stale(self) -> bool:
        return self._age_s > self._values["updates.stale_after"]

    def tick(self) -> None:
        """Publish changes that are due; called about once a second by the node."""
        stale, kept = self._stale, self._updates.in_use
        warmed = kept is not None and kept.drift.thermal_trust > 0.0 and self._temperatures.changed
        aged = self._age_s > max(AGED_S, AGED * self._published_age_s)
        if self._dirty or stale != self._was_stale or warmed or aged:
            self._was_stale = stale
            self._changed()

    def _changed(self) -> None:
        """Publish now, or with the next tick when the last message is less than a second old."""
        self._dirty = True
        if time.monotonic() - self._published_at >= PUBLISH_PERIOD_S:
            self._manager.publish_again()

    def _on_state(self, message: ActuatorState) -> None:
        if not len(message.applied):
            return
        try:
            self.history.observe(applied_from(message, 1e-9 * self._node.get_clock().now().nanoseconds))
        except ValueError as error:
            self._node.get_logger().error(f"actuator_state refused: {error}", throttle_duration_sec=10.0)

    def _on_part(self, name: str, message: Any) -> None:
        if not (self._values["updates.enable"] and self._node.active and self._updates.in_use) or self._busy():
            return
        stamp = stamp_ns(message.header.stamp)
        self._incomplete.setdefault(stamp, {})[name] = message
        if len(self._incomplete[stamp]) == 3:
            self._worker.submit(self._on_map, Measure.Response(**self._incomplete.pop(stamp)), time.monotonic())
        while len(self._incomplete) > INCOMPLETE_KEPT:
            del self._incomplete[next(iter(self._incomplete))]

    def _on_map(self, answer: Measure.Response, arrived: float) -> None:
        """A map that came over the topics at the monotonic time `arrived` (s); runs in the worker thread."""
        log = self._node.get_logger()
        try:
            with self._turn:
                measured = measurement_from(answer)
                if not any(measured.same_map(before) for before in self._compared):
                    self._compare(measured, arrived, dry_run=False)
        except StoreError as error:
            self._refuse(str(error))
            log.warning(f"map not used: {error}", throttle_duration_sec=10.0)
        except EXPECTED as error:
            self._refuse(str(error))
            log.info(f"map not used: {error}", throttle_duration_sec=10.0)
        except Exception as error:  # no map may keep the next one from being taken
            self._refuse(f"{type(error).__name__}: {error}")
            if self._node.context.ok():  # while the process ends, all that this uses is gone
                log.error(f"map not used: {self._last_refusal}")

    def _compare(self, measured: Measurement, arrived: float, dry_run: bool, without: Sequence[int] = ()) -> Verdict:
        """Compare a map with the calibration, and update it if they agree; `_turn` must be held.

        The wait for the driver counts from when the map arrived: while it is silent, maps do not queue up. Other args
        as of :meth:`RecalibrationManager.take`.

        Raises:
            Refusal: a calibration is running, or the driver is silent.
            MapNotUsableError, StoreError: see :meth:`RecalibrationManager.take`.
        """
        self._compared.append(measured)
        still, at = self._values["updates.still_time"], 1e-9 * measured.stamp_ns
        measured = replace(measured, temperature=self._temperatures.at(at))
        wait_s = arrived + REPORT_WAIT_S + still - time.monotonic()
        if not wait_until(lambda: self.history.heard_since(at + still), wait_s):
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "pdm_driver has not reported since the map was taken")
        self._node.check_active()  # it may have been deactivated meanwhile
        if self._busy():
            raise Refusal(ErrorCode.BUSY, "a calibration is running")
        now_ns = self._node.get_clock().now().nanoseconds or math.inf
        with self._exchange:
            verdict = self._updates.take(measured, self.history.settled(at, still), dry_run, without, now_ns)
        if not dry_run:
            self._taken += verdict.accepted
            if not verdict.accepted:
                self._refuse(verdict.reason)
                self._node.get_logger().warning(f"map not used: {verdict.reason}")
            self._changed()
        return verdict

    def _refuse(self, reason: str) -> None:
        self._refused, self._last_refusal = self._refused + 1, reason

    def _on_update(self, request: UpdateCalibration.Request, response: UpdateCalibration.Response) -> Any:
        fill_with_nan(response)  # until they are known
        try:
            if request.forget:
                self._forget(request, response)
            else:
                self._check(request, response)
        finally:
            if (kept := self._updates.in_use) is not None:
                response.revision = kept.drift.revision
                response.gain_drift = abs(kept.drift.largest_gain[0])
                response.offset_drift = kept.drift.offset_rms
        return response

    def _forget(self, request: UpdateCalibration.Request, response: UpdateCalibration.Response) -> None:
        if other := "dry_run" if request.dry_run else "without" if request.without else "":
            raise Refusal(ErrorCode.INVALID_ARGUMENT, f"forget and {other}: only one of them may be set")
        with self._turn:
            self._updates.forget()
        self._changed()
        response.message = "all updates are forgotten"

    def _check(self, request: UpdateCalibration.Request, response: UpdateCalibration.Response) -> None:
        actuators = self._updates.kept().calibration.fit.actuators
        wholes([], 1, actuators, sizes=range(actuators)).check("without", request.without)
        with self._turn:
            timeout = self._values["driver_timeout"]
            busy = "a calibration is running: cancel the action calibrate to end it, or set take_over"
            self._services.hold.wait_for(lambda: not self._busy(), request, busy, timeout)
            with ExitStack() as stack:
                purpose = "a map is compared with the calibration (service update_calibration)"
                try:
                    stack.enter_context(self._services.held(request, purpose))
                except Refusal as refusal:  # a dry run goes on: if the mirror moves, the map is refused anyway
                    if not (request.dry_run and refusal.error_code == ErrorCode.BUSY):
                        raise
                # A map is refused unless the mirror rests before and after it, which corrections of creep may delay.
                wait_until(self._is_at_rest, REPORT_WAIT_S + 2.0 * self._values["updates.still_time"])
                measured = self._services.measure_present_shape("calibration check")
                try:
                    without = [number - 1 for number in request.without]
                    verdict = self._compare(measured, time.monotonic(), request.dry_run, without)
                except MapNotUsableError as error:
                    if not request.dry_run:
                        self._refuse(str(error))
                    raise
        response.accepted, response.message, comparison = verdict.accepted, verdict.reason, verdict.comparison
        response.max_zernike, response.rms = comparison.max_zernike, comparison.rms
        response.surprise = comparison.surprise

    def _is_at_rest(self) -> bool:
        now = 1e-9 * self._node.get_clock().now().nanoseconds
        return self.history.still_for(now) >= self._values["updates.still_time"]

    def health(self) -> tuple[bytes, list[str], dict[str, object]]:
        """Level, warnings and figures for the node's diagnostics."""
        if (kept := self._updates.in_use) is None:
            return OK, [], {}
        updates = kept.drift
        warnings = [doubt.rstrip(".") for doubt in self._doubts()]
        gain, actuator = updates.largest_gain
        if abs(gain) > self._values["updates.gain_drift_max"]:
            warnings.append(f"the gain of actuator {actuator + 1} has drifted by {gain:+.2%}")
        if updates.offset_rms > self._values["updates.offset_drift_max"]:
            warnings.append(f"the figure has drifted by {updates.offset_rms * 1e9:.1f} nm rms")
        figures = updates.figures() | {
            "temperature": self._temperatures.now(),
            "hours_since_check": round(self._age_s / 3600.0, 3),
            "maps_taken": self._taken,
            "maps_refused": self._refused,
            "last_refusal": self._last_refusal,
        }
        return WARN if warnings else OK, warnings, figures
