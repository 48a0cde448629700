"""The action `autofocus`: search the sharpest focus, and stay on it when asked to."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from dm_msgs.action import Autofocus
from dm_msgs.msg import Capabilities
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_autofocus.autofocus_parameters import focus_lens, search_config
from dm_autofocus.focus_probe import FocusProbe, SharpnessSample
from dm_autofocus.optics import FocusOptics, depth_of_focus, distance_of
from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.defocus_search import BEYOND
from dm_autofocus.search.focus_search import FocusSearch
from dm_autofocus.search.peak_search import Peak, Phase, SearchConfig
from dm_autofocus.search.tracking import TrackConfig, Tracker
from dm_autofocus.sharpness import Region, check_region, cut
from dm_common.errors import ErrorCode, Refusal
from dm_common.optics.zernike import curvature_of_defocus
from dm_common.ros.worker import WorkerActionServer
from dm_common.values import Fields, real, reals

#: Share of the reachable range left out at each end: the controller's own test of the limits must not fail on rounding.
MARGIN = 0.002
#: Uncertainty of the mirror's curvature with which it stands where it is sent, in depths of focus.
TRUSTED = 2.0


def ready_capabilities(probe: FocusProbe) -> Capabilities:
    """The mirror's capabilities. Raises Refusal when it cannot be focused."""
    capabilities = probe.capabilities
    if capabilities is None:
        raise Refusal(ErrorCode.TIMEOUT, "no capabilities from focus_controller yet: is it running?")
    if capabilities.quality == Capabilities.UNCALIBRATED:
        raise Refusal(capabilities.error_code or ErrorCode.NOT_CALIBRATED, capabilities.message)
    return capabilities


AUTOFOCUS = Fields(
    {"region": reals([], 0.0, 1.0, sizes=(0, 4)), "curvature_min": real(0.0), "curvature_max": real(0.0)}
)


class AutofocusAction:
    """Serves `autofocus` in worker threads; the newest goal pre-empts.

    Args:
        node: hosts the action.
        probe: moves and measures.
        values: parameters of the node.
        optics: from curvatures to distances.
        publish: (phase, sample): publishes an image that counted.
    """

    def __init__(
        self,
        node: Node,
        probe: FocusProbe,
        values: Mapping[str, Any],
        optics: FocusOptics,
        publish: Callable[[Phase, SharpnessSample], None],
    ) -> None:
        self._log = node.get_logger()
        self._probe = probe
        self._values = values
        self._optics = optics
        self._publish = publish
        self._server = WorkerActionServer(
            node, Autofocus, "autofocus", self._run, exclusive="preempt", fields=AUTOFOCUS
        )

    @property
    def busy(self) -> bool:
        """Whether a goal is running."""
        return self._server.busy

    def _run(self, goal_handle: ServerGoalHandle) -> tuple[str, Any]:
        started = time.monotonic()
        result = Autofocus.Result()
        self._probe.start()
        try:
            config, region = self._config(goal_handle.request)
            with self._probe.held(goal_handle.request):
                peak, config, swept = self._search(goal_handle, config, region)
                self._fill(result, peak)
                if goal_handle.request.track:
                    self._track(goal_handle, config, region, peak, result)
            outcome, result.error_code = "succeed", ErrorCode.OK
            result.message = f"sharpest at {peak.curvature:+.4f} 1/m, {_distance_text(result.dioptre)}"
            if swept:
                result.message += f"; the range was swept: {swept}"
            if peak.at_limit:
                result.message += "; at the end of the range: the object may lie beyond it"
        except Refusal as error:
            outcome = "canceled" if error.error_code == ErrorCode.CANCELED else "abort"
            result.error_code, result.message = error.error_code, str(error)
        finally:
            self._probe.release()
        result.images, result.images_dropped = self._probe.counted, self._probe.dropped
        result.duration = time.monotonic() - started
        return outcome, result

    def _config(self, goal: Any) -> tuple[SearchConfig, Region]:
        """The search that a goal asks for. Raises Refusal."""
        capabilities = ready_capabilities(self._probe)
        margin = MARGIN * (capabilities.curvature_max - capabilities.curvature_min)
        low, high = capabilities.curvature_min + margin, capabilities.curvature_max - margin
        if goal.curvature_min != 0 or goal.curvature_max != 0:
            wanted = (goal.curvature_min, goal.curvature_max)
            if not (low - margin <= wanted[0] < wanted[1] <= high + margin):
                raise Refusal(
                    ErrorCode.OUT_OF_RANGE,
                    f"curvature_min, curvature_max = {wanted[0]:+.4f}, {wanted[1]:+.4f} 1/m: must be a rising range "
                    f"inside {low:+.4f} to {high:+.4f} 1/m, or both 0",
                )
            low, high = max(wanted[0], low), min(wanted[1], high)
        try:
            region = check_region(goal.region if len(goal.region) else self._values["region"])
            return search_config(self._values, capabilities.aperture_radius, low, high), region
        except ValueError as error:
            raise Refusal(ErrorCode.OUT_OF_RANGE, str(error)) from error

    def _search(
        self, goal_handle: ServerGoalHandle, config: SearchConfig, region: Region
    ) -> tuple[Peak, SearchConfig, str]:
        """Search from beginning to end and stand on the peak; without one, where the mirror stood before.

        Returns:
            The peak; the search with the range that was possible, which depends on the actuators' history too; the
            reason why the range was swept, "" = it was not.
        """
        before = self._probe.curvature
        approach = self._values["search.approach"]
        search = FocusSearch(replace(config, approach=0.0), self._model(config, region), before)
        while not search.done:
            step = search.step
            try:
                self._go(goal_handle, step.curvature)
            except Refusal as error:
                if error.error_code != ErrorCode.UNREACHABLE:
                    raise
                self._draw_in(search, error)
                continue
            if search.config.approach < approach and not self._stands_where_sent():
                search.sweep("the mirror's hysteresis is not known", approach)
                continue
            if not step.measured:
                search.feed(None)
                continue
            phase, sample = search.phase, self._measure(goal_handle, region)
            search.feed(sample.sharpness, sample.regions)
            self._report(goal_handle, phase, sample, step.curvature, search.measured, search.steps)
        if search.reason:
            self._log.info(f"the range was swept: {search.reason}")
        if search.peak is None:
            if math.isfinite(before):
                self._go(goal_handle, before)
            raise Refusal(
                ErrorCode.NOT_CONVERGED,
                "the sharpness does not change with focus: no texture in the region of interest, or no object inside "
                "the range; the mirror is back where it was",
            )
        self._go(goal_handle, search.step.curvature)
        return search.peak, search.config, search.reason

    def _model(self, config: SearchConfig, region: Region) -> DefocusModel | str:
        """How images of the region are blurred, or the reason why that is not known."""
        radius, image = ready_capabilities(self._probe).aperture_radius, self._probe.newest
        if not self._values["search.few_images"]:
            return "search.few_images is false"
        if image is None:
            return "there was no image yet to show its size"
        try:
            lens = focus_lens(self._values, radius, self._probe.camera_info)
            shape = cut(np.empty((image.height, image.width), np.uint8), region).shape
            return DefocusModel(shape, lens, config.high - config.low + BEYOND * config.tolerance)
        except ValueError as error:  # no focal length, or too small
            return str(error)

    def _stands_where_sent(self) -> bool:
        """Whether the mirror has the curvature that was asked for, by what the controller answered last."""
        answer, radius = self._probe.answer, ready_capabilities(self._probe).aperture_radius
        if answer is None or not answer.history_known:
            return False
        uncertainty = curvature_of_defocus(answer.predicted_max_zernike_upper, radius)
        return uncertainty < TRUSTED * depth_of_focus(radius, self._values["optics.wavelength"])

    def _draw_in(self, search: FocusSearch, error: Refusal) -> None:
        try:
            search.refuse()
        except ValueError as reason:
            raise Refusal(ErrorCode.UNREACHABLE, f"{reason}: {error}") from error

    def _track(
        self, goal_handle: ServerGoalHandle, config: SearchConfig, region: Region, peak: Peak, result: Any
    ) -> None:
        """Stay on the peak until cancelled or pre-empted: ends by Refusal only."""
        values = self._values
        trials = TrackConfig(values["track.dither"] * config.tolerance, values["track.drop"], values["track.patience"])
        tracker = Tracker(peak.curvature, peak.sharpness, config.low, config.high, trials)
        position = peak.curvature
        while True:
            wanted = tracker.step.curvature
            if wanted != position:
                self._go(goal_handle, wanted)
                position = wanted
            sample = self._measure(goal_handle, region)
            tracker.feed(sample.sharpness)
            self._report(goal_handle, Phase.TRACK, sample, wanted, 0, 0)
            if tracker.lost:
                try:
                    peak, config, _swept = self._search(goal_handle, config, region)
                    position = peak.curvature
                except Refusal as error:
                    if error.error_code != ErrorCode.NOT_CONVERGED:
                        raise
                    # Nothing to see now: what is seen here from now on is the new normal.
                    peak = Peak(tracker.centre, sample.sharpness, False)
                    position = math.nan
                tracker = Tracker(peak.curvature, peak.sharpness, config.low, config.high, trials)
            self._fill(result, Peak(tracker.centre, tracker.sharpness, peak.at_limit))

    def _go(self, goal_handle: ServerGoalHandle, curvature: float) -> None:
        self._probe.move(curvature, lambda: self._stopping(goal_handle))
        self._check_stop(goal_handle)

    def _measure(self, goal_handle: ServerGoalHandle, region: Region) -> SharpnessSample:
        sample = self._probe.measure(region, lambda: self._stopping(goal_handle))
        self._check_stop(goal_handle)
        assert sample is not None  # only a stop leaves without one
        return sample

    def _stopping(self, goal_handle: ServerGoalHandle) -> bool:
        return goal_handle.is_cancel_requested or self._server.preempted(goal_handle)

    def _check_stop(self, goal_handle: ServerGoalHandle) -> None:
        if goal_handle.is_cancel_requested:
            raise Refusal(ErrorCode.CANCELED, "canceled; the mirror holds the shape it has")
        if self._server.preempted(goal_handle):
            raise Refusal(ErrorCode.PREEMPTED, "a newer goal took over")

    def _report(
        self,
        goal_handle: ServerGoalHandle,
        phase: Phase,
        sample: SharpnessSample,
        curvature: float,
        step: int,
        steps: int,
    ) -> None:
        self._publish(phase, sample)
        goal_handle.publish_feedback(
            Autofocus.Feedback(
                phase=int(phase), step=step, steps=steps, curvature=curvature, sharpness=sample.sharpness
            )
        )

    def _fill(self, result: Any, peak: Peak) -> None:
        result.curvature, result.power, result.at_limit = peak.curvature, 2 * peak.curvature, peak.at_limit
        result.dioptre = self._optics.dioptre_for(peak.curvature)
        result.distance = distance_of(result.dioptre)
        result.sharpness = peak.sharpness


def _distance_text(dioptre: float) -> str:
    """A focus distance for a person."""
    if math.isnan(dioptre):
        return "nearer than any object"
    return f"{1 / dioptre:.2f} m ({dioptre:+.4f} dioptre)" if dioptre > 0 else f"infinity ({dioptre:+.4f} dioptre)"
