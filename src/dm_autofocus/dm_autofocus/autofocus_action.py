"""The action `autofocus`: search the sharpest focus, and stay on it when asked to."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from dm_msgs.action import Autofocus

from dm_autofocus.autofocus_parameters import focus_lens, given_focal_length, search_config
from dm_autofocus.focus_probe import SharpnessSample
from dm_autofocus.images import exposure_fault, grey, raw_image
from dm_autofocus.optics import depth_of_focus, distance_of
from dm_autofocus.probe_action import GOAL_FIELDS, START_GRACE_S, ProbeAction, range_of, ready_capabilities
from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.defocus_search import BEYOND
from dm_autofocus.search.focus_search import FocusSearch
from dm_autofocus.search.peak_search import Peak, Phase, SearchConfig
from dm_autofocus.search.tracking import MotionTracker, TrackConfig, Tracker
from dm_autofocus.sharpness import Region, check_region, cut
from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import seconds
from dm_common.optics.zernike import curvature_of_defocus
from dm_common.ros.worker import WorkerGoal
from dm_common.values import Fields, from_values, reals

#: Errors of moves after the controller has died, until a new one has calibration and driver.
_AWAY = (ErrorCode.TIMEOUT, ErrorCode.NODE_INACTIVE, ErrorCode.DRIVER_UNAVAILABLE, ErrorCode.NOT_CALIBRATED)
#: Largest uncertainty of a move's curvature, in depths of focus, for which moves count as accurate.
TRUSTED = 2.0


class AutofocusAction(ProbeAction):
    """Serves `autofocus`."""

    action_type, name = Autofocus, "autofocus"
    fields = Fields(GOAL_FIELDS | {"region": reals([], 0.0, 1.0, sizes=(0, 4))})

    def _plan(self, goal: Any) -> tuple[SearchConfig, Region]:
        capabilities = ready_capabilities(self._probe)
        low, high = range_of(goal, capabilities)
        try:
            region = check_region(goal.region if len(goal.region) else self._values["region"])
            return search_config(self._values, capabilities.aperture_radius, low, high), region
        except ValueError as error:
            raise Refusal(ErrorCode.OUT_OF_RANGE, str(error)) from error

    def _carry_out(self, goal_handle: WorkerGoal, plan: tuple[SearchConfig, Region], result: Any) -> None:
        peak, config, remarks = self._search(goal_handle, *plan)
        self._fill(result, peak)
        if goal_handle.request.track:
            self._track(goal_handle, config, plan[1], peak, result)
        known = math.isfinite(peak.error)
        error = abs(self._optics().dioptre_for(peak.curvature + peak.error) - result.dioptre) if known else math.nan
        result.message = f"sharpest at {peak.curvature:+.4f} 1/m, {_distance_text(result.dioptre, error)}{remarks}"
        if peak.at_limit:
            result.message += "; at the end of the range: the object may lie beyond it"

    def _search(self, goal_handle: WorkerGoal, config: SearchConfig, region: Region) -> tuple[Peak, SearchConfig, str]:
        """Search from beginning to end and stay on the peak; if none is found, return to the previous shape.

        Returns:
            The peak; the search with the range that was possible, which depends on the actuators' history as well;
            remarks for the result's message.
        """
        before = self._probe.shape
        sample: SharpnessSample | None = None
        approach = self._values["search.approach"]
        search = FocusSearch(replace(config, approach=0.0), self._model(config, region), before[0])
        while not search.current.done:
            step = search.current.step
            try:
                self._probe.move(step.curvature)
            except Refusal as error:
                if error.error_code != ErrorCode.UNREACHABLE:
                    raise
                _draw_in(search.refuse, error)
                continue
            if search.current.config.approach < approach and (doubt := self._doubt()):
                search.sweep(doubt, approach)
                continue
            if not step.measured:
                search.feed(None)
                continue
            phase, sample = search.current.phase, self._probe.measure(region)
            search.feed(sample.sharpness, sample.regions)
            self._report(goal_handle, phase, sample, step.curvature, step=search.measured, steps=search.steps)
        if search.reason:
            self._log.info(f"the range was swept: {search.reason}")
        if search.current.peak is None:
            left = "the mirror stays where it is"
            if math.isfinite(before[0]):
                self._probe.move(*before)
                left = "the mirror is back where it was"
            fault = exposure_fault(sample.regions[0]) if sample else ""
            raise Refusal(
                ErrorCode.NOT_CONVERGED,
                "the sharpness does not change with focus: no texture in the region of interest, or no object inside "
                f"the range{fault and '; '}{fault}; {left}{self._remarks(search)}",
            )
        self._probe.move(search.current.step.curvature)
        return search.current.peak, search.current.config, self._remarks(search)

    def _remarks(self, search: FocusSearch) -> str:
        """Remarks for the user on how the focus was found, or why it was not."""
        swept = f"; the range was swept: {search.reason}" if search.reason else ""
        given = given_focal_length(self._values, self._probe.camera_info)
        where = "(optics.focal_length_px, or fx of camera_info)"
        if search.current.peak is None:
            return swept + (f"; check the focal length, {given:.0f} px {where}" if search.unexplained else "")
        scale = search.fitting_scale()
        if scale == 1:
            return swept
        return swept + (
            f"; the blur of the images fits a focal length of {scale * given:.0f} px, but {given:.0f} px is given "
            f"{where}"
        )

    def _model(self, config: SearchConfig, region: Region) -> DefocusModel | str:
        """The model of how images of the region are blurred, or the reason why there is none."""
        radius, newest = ready_capabilities(self._probe).aperture_radius, self._probe.newest
        if not self._values["search.few_images"]:
            return "search.few_images is false"
        if newest is None:
            return "there was no image yet to show its size"
        try:
            lens = focus_lens(self._values, radius, self._probe.camera_info)
            image = raw_image(newest)
            pixels = grey(image)
            # Of a Bayer pattern, `grey` returns half as many pixels along each side.
            lens = replace(lens, focal_length_px=lens.focal_length_px * pixels.shape[1] / image.width)
            return DefocusModel(cut(pixels, region).shape, lens, config.high - config.low + BEYOND * config.tolerance)
        except ValueError as error:  # no focal length, or too small
            return str(error)

    def _doubt(self) -> str:
        """Why the mirror may not move accurately; "" = it does. Slow creep does not count: all images share it."""
        answer, capabilities = self._probe.answer, ready_capabilities(self._probe)
        if answer is None or not answer.history_known:
            return "the mirror's hysteresis is not known"
        radius, bound = capabilities.aperture_radius, capabilities.error_bound
        if curvature_of_defocus(bound, radius) < TRUSTED * depth_of_focus(radius, self._values["optics.wavelength"]):
            return ""
        return f"moves may err by {bound * 1e9:.0f} nm"

    def _track(self, goal_handle: WorkerGoal, config: SearchConfig, region: Region, peak: Peak, result: Any) -> None:
        """Stay on the peak until an error, cancelling or pre-emption ends it; a controller that died is waited for."""
        tracker = self._tracker(peak, config, region)
        position = peak.curvature
        while True:
            try:
                wanted = tracker.step.curvature
                if wanted != position:
                    try:
                        self._probe.move(wanted)
                    except Refusal as error:
                        answer = self._probe.answer
                        if error.error_code != ErrorCode.UNREACHABLE or answer is None:
                            raise
                        _draw_in(partial(tracker.refuse, answer.curvature_min, answer.curvature_max), error)
                        position = math.nan  # no image counts before the next move
                        continue
                    position = wanted
                sample = self._probe.measure(region)
                tracker.feed(sample.sharpness, sample.regions, seconds(sample.image.header.stamp))
                self._report(goal_handle, Phase.TRACK, sample, wanted)
                if tracker.lost:
                    peak, config, _remarks = self._search(goal_handle, config, region)
                    position = peak.curvature
                    tracker = self._tracker(peak, config, region)
            except Refusal as error:
                if error.error_code == ErrorCode.NOT_CONVERGED:
                    # Nothing to focus on: the present sharpness becomes the new reference, until something comes.
                    peak = Peak(tracker.centre, sample.sharpness, False)
                    position = math.nan
                    tracker = self._tracker(peak, config, region)
                    tracker.found = False
                elif error.error_code in _AWAY and self._probe.controller.changed_within(START_GRACE_S):
                    self._log.warning(f"tracking waits: {error}", throttle_duration_sec=5.0)
                    time.sleep(0.1)
                else:
                    raise
            self._fill(result, Peak(tracker.centre, tracker.sharpness, peak.at_limit))

    def _tracker(self, peak: Peak, config: SearchConfig, region: Region) -> Tracker:
        """The tracker of a peak: by the optics if camera and mirror are known, else by sharpness alone."""
        trials = from_values(TrackConfig, self._values, "track.")
        model = self._model(config, region)
        if isinstance(model, DefocusModel) and trials.dither > 0 and not self._doubt():
            return MotionTracker(peak, config, trials, model)
        return Tracker(peak, config, trials)

    def _report(
        self, goal_handle: WorkerGoal, phase: Phase, sample: SharpnessSample, curvature: float, **progress: int
    ) -> None:
        self._publish(phase, sample)
        figures = {"curvature": curvature, "sharpness": sample.sharpness} | progress
        goal_handle.publish_feedback(Autofocus.Feedback(phase=int(phase), **figures))

    def _fill(self, result: Any, peak: Peak) -> None:
        result.curvature, result.power, result.at_limit = peak.curvature, 2 * peak.curvature, peak.at_limit
        result.dioptre = self._optics().dioptre_for(peak.curvature)
        result.distance = distance_of(result.dioptre)
        result.sharpness = peak.sharpness


def _draw_in(refuse: Callable[[], None], error: Refusal) -> None:
    """Shrink the range to exclude what the mirror refused. Raises Refusal if hardly anything of it is left."""
    try:
        refuse()
    except ValueError as reason:
        raise Refusal(ErrorCode.UNREACHABLE, f"{reason}: {error}") from error


def _distance_text(dioptre: float, error: float) -> str:
    """A focus distance for a person, with its standard error [1/m]; NaN = not known."""
    if math.isnan(dioptre):
        return "nearer than any object"
    figure = f"{dioptre:+.4f} dioptre" if math.isnan(error) else f"{dioptre:+.4f} +- {error:.4f} dioptre"
    return f"{1 / dioptre:.2f} m ({figure})" if dioptre > 0 else f"infinity ({figure})"
