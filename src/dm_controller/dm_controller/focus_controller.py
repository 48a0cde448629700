"""Open-loop focus control without ROS: requests, driver reports and time in, commands and events out.

One object holds all that changes: the calibration in use, the estimate of the actuators, the shape that is held against
creep, a degauss under way and the order that waits for it. The caller calls one method at a time and carries out the
effects in the order given.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, FocusRequest

from dm_common.errors import NO_CALIBRATION, ErrorCode, Refusal
from dm_common.hysteresis.observer import ActuatorEstimate, HysteresisObserver
from dm_common.messages import applied_from, stamp_ns, unused_as_requested
from dm_controller.conditioning import Conditioning
from dm_controller.creep_hold import CreepHold
from dm_controller.driver_monitor import DriverMonitor
from dm_controller.focus_types import (
    Effect,
    Log,
    Moment,
    Order,
    PublishCapabilities,
    PublishEstimate,
    PublishState,
    SendCommand,
    StartDegauss,
)
from dm_controller.planning.active_calibration import NO_TILT, ActiveCalibration, active_calibration
from dm_controller.planning.choice import Degauss, PlanningContext, choose_move, unreachable
from dm_controller.planning.planner import Move
from dm_controller.planning.target import REQUEST, FocusTarget

#: Period of checks of a held shape while no correction can be due sooner, s; period of publishing the estimate of the
#: actuators while the mirror moves, s of wall time.
SLOW_PERIOD_S, ESTIMATE_PERIOD_S = 1.0, 0.25


class FocusController:
    """Takes one mirror to the shapes that are asked for.

    Args:
        values: parameters of the node `focus_controller`, live.

    Attributes:
        active: the calibration in use; None = there is none.
        not_calibrated: the reason for that.
        requests, refused: counts since the start.
        degauss_offered: returns whether the driver offers the action `degauss`.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.active: ActiveCalibration | None = None
        self.not_calibrated = Refusal(ErrorCode.NOT_CALIBRATED, NO_CALIBRATION)
        self.observer, self.monitor = HysteresisObserver(), DriverMonitor(values)
        self.hold, self.conditioning = CreepHold(values, self.monitor), Conditioning()
        # Driver's state in the last capabilities, and last estimate; when the next estimate is due, s, steady.
        self._reported: tuple[object, ...] = ()
        self._estimated: tuple[object, ...] = ()
        self._estimate_due = 0.0
        self._at_rest: ActuatorEstimate | None = None  # of a mirror at rest, until its next report
        self.requests = self.refused = 0
        self.degauss_offered: Callable[[], bool] = lambda: False

    # --- what is known ---

    def use(self, calibration: Any, mirror: Any, recipes: Any = None) -> list[Effect]:
        """Use calibration, mirror and recipes (dm_msgs); if `active_calibration` refuses them, refuse all requests."""
        before, effects = self.active, list[Effect]()
        hold_tilt, axis = self._values["hold_tilt"], self._values["optical_axis"]
        try:
            active = active_calibration(calibration, mirror, hold_tilt, axis, recipes)
            # A new revision leaves the present shape as it is, so the hold can continue.
            if before is None or before.calibration.id != active.calibration.id:
                self.hold.end("another calibration is used")
            elif not before.planner.law.same_as(active.planner.law):
                self.hold.end("the hysteresis model changed")
            self.observer.use(active.planner.law, active.middle, active.planner.hysteresis is not None)
            active.note_creep_shown(before, self.observer.state)
            self.active, self._at_rest = active, None
            effects.append(Log("info", f"using calibration {active.calibration.id} of {mirror.serial}"))
            if hold_tilt and active.mirror.tilt is None:
                effects.append(Log("warning", f"calibration {active.calibration.id}: {NO_TILT}"))
        except Refusal as refusal:
            self.active, self.not_calibrated = None, refusal
            self.hold.end("there is no calibration to hold it with")
            if refusal.error_code in (ErrorCode.CALIBRATION_MISMATCH, ErrorCode.CALIBRATION_UNREADABLE):
                effects.append(Log("error", str(refusal)))
            elif before is not None:
                effects.append(Log("warning", f"calibration {before.calibration.id} is withdrawn: {refusal}"))
        return [*effects, PublishCapabilities()]

    def rest(self, refusal: Refusal, now: Moment) -> list[Effect]:
        """Use no calibration until `use` is called again: requests are refused, and the mirror stays as it is."""
        self.hold.end("the node was deactivated")
        self.active, self.not_calibrated = None, refusal
        return [*self._degauss_ended(now, refusal), PublishCapabilities()]

    def driver_report(self, report: ActuatorState, now: Moment) -> list[Effect]:
        """Take the driver's next report."""
        report = unused_as_requested(report)
        latency_learnt, gain = self.monitor.observe(report, now.steady), self.monitor.clock_gain(report, now)
        with suppress(ValueError):  # the observer reports it as an unknown history, and begins anew
            self.observer.observe(applied_from(report, now.time), gain)
        if report.driver_state != ActuatorState.STATE_ACTIVE:
            self.hold.end("the driver is not active")
        elif self.hold.active and self.monitor.previous_order is None:
            self.hold.driver_requested(report.requested, now.steady)
        self._at_rest = None if report.moving else self.observer.estimate(now.time)
        if self.active is not None and self._at_rest is not None and self._at_rest.state is not None:
            self.active.planner.prepare(self._at_rest.state)
        effects = self._degauss_ended(now, None) if self.conditioning.reported(self.monitor) else []
        effects += [*self.monitor.settled(), *self.monitor.ended_early(now.steady)]
        if gain:
            text = f"the clock jumped {gain:.0f} s ahead: whether the mirror crept for so long is not known"
            effects.append(Log("warning", text))
        return [*effects, *self._news(now, latency_learnt)]

    def unavailable(self, now: Moment) -> Refusal | None:
        """The reason why requests are refused now, whatever they ask for; None = they are not."""
        return self.not_calibrated if self.active is None else now.refusal or self.monitor.refusal(now.steady)

    def _news(self, now: Moment, more: bool = False) -> list[Effect]:
        """Publish capabilities if the driver's state changed or if `more`; a changed estimate, rarely during moves."""
        refusal, observer, effects = self.unavailable(now), self.observer, list[Effect]()
        known = refusal.error_code if refusal else ErrorCode.OK, observer.unknown
        if more or self._reported != known:
            self._reported = known
            effects.append(PublishCapabilities())
        estimated = observer.state, observer.unknown, self.active
        due = not (observer.latest and observer.latest.moving) or now.steady >= self._estimate_due
        if estimated != self._estimated and due:
            self._estimated, self._estimate_due = estimated, now.steady + ESTIMATE_PERIOD_S
            effects.append(PublishEstimate())
        return effects

    # --- requests ---

    def request(self, request: FocusRequest, now: Moment, dry_run: bool = False) -> tuple[Order, list[Effect]]:
        """Judge a request and, unless it is refused or a dry run, send its command, or have the mirror degaussed first.

        The newest request wins.
        """
        self.requests += 1
        order = Order(request, now)
        return order, self._attempt(order, now, dry_run)

    def move_for(self, request: FocusRequest, now: Moment, degaussed: int | None = None) -> Move:
        """The move that a request asks for, from the mirror as it is.

        Args:
            degaussed: half-swings of a degauss that has just ended; None = the request is new.

        Raises:
            Refusal: it cannot be carried out whatever the driver does: no calibration, too old, no such surface.
        """
        values, active = self._values, self.active
        limit, stamp = values["request_age"], stamp_ns(request.header.stamp)
        age = 1e-9 * (now.ns - stamp)
        if degaussed is None and limit and stamp and not -limit <= age <= limit:
            when = f"{age:.3f} s old" if age > 0.0 else f"stamped {-age:.3f} s ahead"
            raise Refusal(ErrorCode.STALE, f"header.stamp: the request is {when}; allowed: {limit:g} s (request_age)")
        REQUEST.check(request)
        target = FocusTarget(request.curvature, request.conic_constant, tuple(request.zernike))
        settle, budget = values["settle_time"], request.time_budget or values["time_budget"]
        if active is None:
            raise self.not_calibrated
        estimate = self._at_rest or self.observer.estimate(now.time, active.planner.slew_rate)
        if degaussed is not None:
            degauss = Degauss(degaussed, True, 0.0)
        elif self.conditioning.run is not None or request.mode == FocusRequest.MODE_CONDITIONED or budget:
            degauss = self.conditioning.expected_degauss(active, values["condition.degauss_steps"], now.steady)
        else:  # no time for a degauss: at once, from the present state
            return active.planner.plan(target, estimate.state, now.time, not estimate.unknown, ahead=settle)
        context = PlanningContext(active, estimate, now.time, settle, degauss)
        return choose_move(target, request.mode, budget, context)

    def _attempt(self, order: Order, now: Moment, dry_run: bool = False, degaussed: int | None = None) -> list[Effect]:
        active, effects = self.active, list[Effect]()
        order.began, order.active, order.move = now, active, None
        order.unknown = (self._at_rest or self.observer).unknown
        order.creep_held = active is not None and self._values["hold.enable"] and active.planner.law.creep_rate > 0.0
        try:
            move = order.move = self.move_for(order.request, now, degaussed)
            tolerance = self._values["reachable_tolerance"]
            if not move.max_zernike <= tolerance:
                assert active is not None  # else it is refused
                raise unreachable(move, active, tolerance)
            if not dry_run:
                if now.simulated and (refusal := now.refusal):
                    raise refusal
                if now.steady > self.monitor.open_until:
                    self.monitor.check(order.request, now.steady)
                at_once = degaussed is not None or (move.degauss is None and self.conditioning.run is None)
                effects += (self._go if at_once else self._condition)(order, move, now)
        except Refusal as refusal:
            if self.active is None and refusal is self.not_calibrated and not dry_run:
                refusal = self.monitor.held(order.request) or refusal  # as while the first calibration runs
            self.refused += 1
            order.refusal = refusal
            effects.append(Log("warning", f"refused: {refusal}"))
        # The outcome of a command is published once the driver has reported it.
        if not dry_run and (order.refusal is not None or order.pending):
            effects.append(PublishState(order))
        return effects

    def refuse(self, order: Order, refusal: Refusal, now: Moment) -> list[Effect]:
        """Refuse an order that was not refused when it was judged."""
        self.refused += 1
        order.began, order.move, order.refusal, order.answered = now, None, refusal, True
        return [Log("warning", f"refused: {refusal}"), PublishState(order)]

    def _go(self, order: Order, move: Move, now: Moment) -> list[Effect]:
        """Send the command of `move` and hold its shape; until the driver takes it, the shape before is held."""
        order.command = SendCommand(move.signals, now, 0, order.request.holder, order.request.take_over)
        order.sent, order.checked, order.starts = [order.command], now.time, self.monitor.starts
        effects: list[Effect] = [order.command]
        if (before := self.monitor.order) is not None and before.command is not None:
            if not before.answered:
                effects += self.monitor.settled("a newer request took its place before the driver confirmed it")
            order.previous_order = before if before.applied else before.previous_order
        self.monitor.order = order
        return effects

    # --- a degauss on the way ---

    def _condition(self, order: Order, move: Move, now: Moment) -> list[Effect]:
        """Have the mirror degaussed before `order` is carried out, unless a degauss is under way already."""
        if not self.degauss_offered():
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "action degauss: pdm_driver does not offer it (yet)")
        before, effects = self.conditioning.wait(order), list[Effect]()
        if before is not None:
            before.pending = False
            refusal = Refusal(ErrorCode.PREEMPTED, "a newer request took its place during the degauss")
            effects += self.refuse(before, refusal, now)
        if self.conditioning.run is None:
            number = self.conditioning.begin(move.degauss or 0, self.monitor, now.steady)
            effects.append(StartDegauss(number, move.degauss or 0, order.request.holder, order.request.take_over))
        return effects

    def degauss_answered(
        self, number: int, now: Moment, duration: float = 0.0, refusal: Refusal | None = None
    ) -> list[Effect]:
        """Note that the driver has answered the degauss of run `number`: done in `duration` s, or refused."""
        if self.conditioning.run is None or self.conditioning.run.number != number:
            return []
        if refusal is not None:
            return self._degauss_ended(now, refusal)
        self.conditioning.answered(duration, now.steady)
        ended = self._degauss_ended(now, None) if self.conditioning.reported(self.monitor) else []
        return [PublishCapabilities(), *ended]

    def _degauss_ended(self, now: Moment, refusal: Refusal | None) -> list[Effect]:
        run, order = self.conditioning.run, self.conditioning.end()
        if order is None:
            return []
        if refusal is not None:
            return self.refuse(order, refusal, now)
        return self._attempt(order, now, degaussed=run.steps if run is not None else 0)

    # --- time ---

    def tick(self, now: Moment, driver_loss: str = "") -> list[Effect]:
        """Do what is due: creep corrections, and refusals of what the driver did not take or does not finish.

        `driver_loss`: what happened to a driver that is known to be dead, as a sentence; "" = it may live.
        """
        self.monitor.lost(driver_loss)
        effects: list[Effect] = []
        if failure := self.conditioning.failure(self.monitor, self._values["condition.timeout"], now.steady):
            effects += self._degauss_ended(now, failure)
        order = self.monitor.order
        if order is not None and (unconfirmed := self.monitor.unconfirmed(now.steady)) is not None:
            self.hold.not_confirmed()
            # If the request was answered already, only a correction or the end of a move was not taken.
            effects += [Log("warning", str(unconfirmed))] if order.answered else self.refuse(order, unconfirmed, now)
        effects += [*self.monitor.ended_early(now.steady), *self._news(now)]
        if not self.conditioning.run:  # a correction would end the degauss
            effects += self.hold.command(self.observer.estimate(now.time), now)
        return effects

    def needs_fast_timer(self, now: Moment) -> bool:
        """Whether something can be due before `SLOW_PERIOD_S` has passed."""
        return self.conditioning.run is not None or self.hold.next_check - now.time <= SLOW_PERIOD_S

    def stop(self, order: Order, now: Moment) -> list[Effect] | None:
        """Stop the move of `order` where it is; None = another shape was asked for since, and nothing is sent."""
        report, last = self.monitor.latest, self.monitor.order
        if last is None or not self.monitor.keeps(order):
            return None
        self.hold.end("the move was cancelled")
        effects = self.monitor.cancelled(now.steady)
        last.stopped = True
        if report is not None and len(report.applied):
            effects.append(last.leave_at(np.array(report.applied), now))
        return effects
