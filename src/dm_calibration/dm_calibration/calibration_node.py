"""Node `calibration`: measures the influence function, keeps the calibrations, publishes the one in use."""

import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dm_msgs.action import Calibrate
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.msg import MirrorInfo, RecipeBook
from dm_msgs.srv import (
    FitInfluenceFunction,
    FitRegression,
    ListCalibrations,
    LoadCalibration,
    PredictError,
    StoreRecipes,
)
from rclpy.clock import Clock, ClockType

from dm_calibration import requests
from dm_calibration.calibration import Calibration
from dm_calibration.calibration_action import CalibrateAction
from dm_calibration.calibration_manager import CalibrationManager
from dm_calibration.calibration_messages import calibration_message, driver_facts
from dm_calibration.calibration_parameters import PARAMETERS, fit_options
from dm_calibration.calibrator import refit
from dm_calibration.recalibration.map_listener import PUBLISH_PERIOD_S, MapListener
from dm_calibration.regression.error_prediction import ErrorPrediction
from dm_calibration.report.report_writer import ReportWriter
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.errors import EXPECTED, NO_CALIBRATION, ErrorCode, error_code
from dm_common.hysteresis.creep_record import CreepRecorder
from dm_common.messages import mirror_from, recipe_book_from, recipe_book_message, time_message
from dm_common.recipes import NO_RECIPES
from dm_common.ros import qos
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import WARN, Health, ManagedNode
from dm_common.ros.worker import WorkerActionServer, WorkerGoal, WorkerService
from dm_common.values import reals


class CalibrationNode(ManagedNode):
    """Topics, services and the action of calibration; the work is done by CalibrationManager and CalibrateAction.

    While inactive the node takes no maps and the calibration in use stays; cleanup, or another folder, withdraws it.
    """

    def __init__(self) -> None:
        super().__init__("calibration", PARAMETERS, self._on_parameters, hardware_id="calibration")
        self._frame_id = ""
        self._start_pending = False
        self._loaded_by = ""  # value of `load_on_start` when it was last carried out
        # Latched: a controller that starts later must know the calibration in use.
        self._publisher = self.create_publisher(CalibrationMsg, "calibration", qos.with_lease(qos.LATCHED))
        self._recipes = self.create_publisher(RecipeBook, "recipes", qos.LATCHED)
        self._reports = ReportWriter(self._log_report, self._values)
        self._manager = CalibrationManager(
            CalibrationStore(self._values["calibration_folder"], self._write_report),
            lambda: float(self._values["aperture_tolerance"]),
            lambda: int(self.get_clock().now().nanoseconds),
            self._publish,
            self.inactive,
        )
        self._bench_services = BenchServices(self, self._values)
        self._server = WorkerActionServer(
            self, Calibrate, "calibrate", self._calibrate, exclusive="refuse", fields=requests.CALIBRATE
        )
        self._listener = MapListener(self, self._values, self._manager, self._bench_services, lambda: self._server.busy)
        history = self._listener.history  # begins with the record of the focus controller, which is only read here
        self._recorder = CreepRecorder(self._values["state_folder"], history, self.get_logger().warning)
        WorkerService(self, ListCalibrations, "list_calibrations", self._on_list)
        WorkerService(self, LoadCalibration, "load_calibration", self._on_load, requests.LOAD_CALIBRATION)
        fields = requests.FIT_INFLUENCE_FUNCTION
        WorkerService(self, FitInfluenceFunction, "fit_influence_function", self._on_fit, fields)
        WorkerService(self, StoreRecipes, "store_recipes", self._on_store_recipes, requests.STORE_RECIPES)
        prediction = ErrorPrediction(self._manager, self._values)
        WorkerService(self, FitRegression, "fit_regression", prediction.fit, requests.FIT_REGRESSION)
        WorkerService(self, PredictError, "predict_error", prediction.predict)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._ticker = self.create_timer(PUBLISH_PERIOD_S, self._listener.tick, clock=steady)
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)

    def _on_parameters(self, changes: Mapping[str, Any]) -> None:
        if {"aperture_tolerance", "calibrated_error_max", "updates.surprises_max"} & set(changes):
            self._manager.publish_again()  # receivers judge the calibration by these parameters

    def configure(self) -> None:
        if not self._values["calibration_folder"]:
            raise ValueError("calibration_folder is empty: must name a folder")  # "" means the current directory
        folder = Path(self._values["calibration_folder"]).expanduser()
        if folder != self._manager.store.folder:
            self.clean_up()  # the calibration in use is not in the new folder
            self._manager.store.folder = folder
        self._recorder.folder = self._values["state_folder"]

    def activate(self) -> None:
        wanted, in_use = self._values["load_on_start"], self._manager.in_use is not None
        if in_use and wanted == self._loaded_by:
            return
        self._loaded_by, self._start_pending = wanted, bool(wanted)
        if not (self._start_pending or in_use):  # while loading is pending, do not announce "no calibration"
            self._publish(None, None)
        self._load_pending()

    def clean_up(self) -> None:
        if self._manager.in_use is not None:
            self._manager.use(None)

    def make_safe(self) -> None:
        """Return the mirror to mid range if the process ends in the middle of a calibration."""
        self._listener.stop()
        mirror = self._manager.mirror
        if self._server.busy and self._bench_services.hold.end() and mirror is not None:
            self.get_logger().warning(f"ended during a calibration: {self._bench_services.rest_at_exit(mirror.rest)}")
        super().make_safe()
        self._reports.end()

    def _calibrate(self, handle: WorkerGoal) -> tuple[str, Calibrate.Result]:
        return CalibrateAction(self, self._values, self._bench_services, self._manager, handle).run()

    def _write_report(self, file: Path) -> None:
        if self._values["write_report"]:
            self._reports.write(file)

    def _log_report(self, text: str, warning: bool) -> None:
        if warning:
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)

    def _publish(self, calibration: Calibration | None, file: Path | None) -> None:
        message = calibration_message(calibration, file, self._frame_id, self._values["calibrated_error_max"])
        message.aperture_tolerance = float(self._values["aperture_tolerance"])
        self._listener.begin(calibration)
        self._listener.amend(message)
        # Recipes first, so that nobody takes the calibration for one without recipes.
        book = calibration.recipes if calibration else NO_RECIPES
        if self._listener.recipes_in_doubt:
            book = replace(book, recipes=())
        self._recipes.publish(recipe_book_message(book, message.id))
        self._publisher.publish(message)

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._frame_id = message.header.frame_id
        try:
            mirror = mirror_from(message)
        except ValueError as error:
            self.get_logger().error(f"mirror_info refused: {error}")
            return
        self._manager.driver_facts, before = driver_facts(message), self._manager.mirror
        self._recorder.recall(mirror.serial, 1e-9 * self.get_clock().now().nanoseconds)
        if withdrawn := self._manager.set_mirror(mirror):
            self.get_logger().warning(withdrawn)
        if before is not None and before.serial != mirror.serial and self._manager.in_use is None:
            self._start_pending = bool(self._values["load_on_start"])  # another mirror has a calibration of its own
        if before is not None and before.limits.middle != mirror.limits.middle:
            self._manager.publish_again()  # hysteresis is followed from mid range, where a degauss ends
        self._diagnostics.hardware_id = f"{mirror.name} {mirror.serial}"
        self._load_pending()

    def _load_pending(self) -> None:
        if self._start_pending and self.active and self._manager.mirror is not None:
            self._start_pending = False
            # Reading the folder takes too long for a callback.
            threading.Thread(target=self._load_on_start, daemon=True).start()

    def _load_on_start(self) -> None:
        name = self._values["load_on_start"]
        try:
            if name == "last":
                calibration, reason = self._manager.load_last()
            else:
                calibration, reason = self._manager.load("" if name == "newest" else name)
            self._log_report(f"calibration {calibration.id} loaded at start{reason and '; '}{reason}", bool(reason))
        except EXPECTED as error:
            if name in ("last", "newest") and error_code(error) == ErrorCode.NOT_CALIBRATED:  # normal on a new bench
                self.get_logger().info(f"{error}: calibrate first")
            else:
                self.get_logger().warning(f"load_on_start = {name!r}: {error}")
            self._manager.publish_none()

    def _on_list(self, _request: Any, response: Any) -> Any:
        in_use = self._manager.in_use
        for entry in self._manager.store.entries():
            calibration, remark = entry.calibration, entry.remark
            if calibration:
                remark = "in use" if in_use and calibration.id == in_use.id else self._manager.mismatch(calibration)
            response.ids.append(entry.id)
            response.mirror_serials.append(calibration.mirror_serial if calibration else "")
            response.methods.append(calibration.fit.method if calibration else "")
            response.stamps.append(time_message(calibration.created_ns if calibration else 0))
            response.held_out_rms.append(calibration.fit.held_out_rms if calibration else float("nan"))
            response.remarks.append(remark)
        response.message = f"{len(response.ids)} calibrations in {self._manager.store.folder}"
        return response

    def _on_load(self, request: Any, response: Any) -> Any:
        calibration, warning = self._manager.load(request.calibration)
        response.id = calibration.id
        response.message = f"calibration {response.id} is in use{warning and '; '}{warning}"
        return response

    def _on_fit(self, request: Any, response: Any) -> Any:
        stored = self._manager.named(request.calibration)
        if request.activate:
            self._manager.check_fits(stored)
        provenance = self._manager.provenance(stored.mirror_name, stored.mirror_serial, "")
        mirror = None if self._manager.mismatch(stored) else self._manager.mirror
        options = fit_options(self._values, request.method)
        calibration = refit(stored, options, request.exclude, provenance, mirror)
        response.file = str(self._manager.store.save(calibration))
        response.id = calibration.id
        response.in_sample_rms = calibration.fit.in_sample_rms
        response.held_out_rms = calibration.fit.held_out_rms
        response.condition_number = calibration.fit.condition_number
        response.message = f"fitted again from {stored.id}: {int(calibration.fit.used.sum())} maps used"
        if request.activate and (warning := self._manager.use(calibration)):
            response.message += f"; {warning}"
        return response

    def _on_store_recipes(self, request: Any, response: Any) -> Any:
        for recipe in request.recipes.recipes:
            requests.RECIPE.check(recipe)
            count = len(request.recipes.recipes[0].effective)
            for name, sizes in (("effective", (count,)), ("signals", (count,)), ("by_model", (0, count))):
                reals([], sizes=sizes).check(name, getattr(recipe, name))
        book = recipe_book_from(request.recipes)
        calibration = self._manager.add_recipes(request.recipes.calibration_id, book)
        response.message = (
            f"{len(book.recipes)} recipes stored with calibration {calibration.id}, which now has "
            f"{len(calibration.recipes.recipes)}"
        )
        return response

    def health(self) -> Health:
        calibration, mirror = self._manager.in_use, self._manager.mirror
        values: dict[str, object] = {"calibrating": self._server.busy, "folder": str(self._manager.store.folder)}
        if died := [node.text for node in self._bench_services.nodes if node.missing()]:
            return Health(WARN, "; ".join(died), values)
        if mirror is None:
            return Health(WARN, "no mirror_info: is pdm_driver running?", values)
        if calibration is None:
            return Health(WARN, NO_CALIBRATION, values)
        values["held_out_rms_nm"] = round(calibration.fit.held_out_rms * 1e9, 3)
        values["maps_used"] = int(calibration.fit.used.sum())
        level, warnings, figures = self._listener.health()
        return Health(level, "; ".join((f"calibration {calibration.id}", *warnings)), values | figures)


def main() -> int:
    """Run the node."""
    return run_node(CalibrationNode)


if __name__ == "__main__":
    sys.exit(main())
