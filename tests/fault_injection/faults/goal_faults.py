"""Goals of the focus controller that end half way: cancelled, pre-empted, overtaken."""

from __future__ import annotations

import time
from random import Random
from typing import Any

from dm_msgs.action import Converge, MoveFocus
from dm_msgs.msg import ErrorCode, FocusRequest

from fault_injection.fault import Fault, FaultRecord
from fault_injection.faults import controller_faults
from fault_injection.faults.controller_faults import REGISTRY, fault, lost
from fault_injection.rigs.common_steps import begin_degauss
from fault_injection.rigs.driver_rig import PATIENCE_S, RigError
from fault_injection.rigs.focus_rig import ANSWER_S, FocusRig


def _end_somehow(rig: FocusRig, random: Random, handle: Any, result: Any) -> Any:
    """Cancel at some moment; returns the result."""
    time.sleep(random.choice((0.0, random.uniform(0.0, 0.02), random.uniform(0.0, 1.0))))
    handle.cancel_goal_async()
    rig.wait(result.done, "the result of a goal that was cancelled", ANSWER_S)
    return result.result().result


def _check_ended(record: FaultRecord, outcome: Any, *codes: int) -> None:
    if outcome.error_code not in codes or not outcome.message:
        lost(record, f"ended with error code {outcome.error_code}, {outcome.message!r}; expected {codes}")


def _check_at_rest(rig: FocusRig, record: FaultRecord) -> None:
    """The mirror must come to rest and stay there."""
    rig.wait(lambda: rig.states and not rig.states[-1].moving, "the end of all moves")
    try:
        rig.wait(lambda: _rests(rig), "rest", PATIENCE_S / 2)
    except RigError:
        lost(record, "the mirror does not come to rest")


def _rests(rig: FocusRig) -> bool:
    before = rig.frames
    time.sleep(0.3)
    return rig.frames == before


@fault("move_focus cancelled at any moment", rounds=20)
def move_cancelled(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    goal = MoveFocus.Goal(request=FocusRequest(curvature=rig.far_curvature(random)))
    handle, result = rig.goal(MoveFocus, goal)
    _check_ended(record, _end_somehow(rig, random, handle, result), ErrorCode.OK, ErrorCode.CANCELED)


@fault("goals of move_focus that pre-empt each other at any moment; the newest must stand", rounds=10)
def move_preempted(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    goals = []
    for _ in range(random.randint(2, 6)):
        goal = MoveFocus.Goal(request=FocusRequest(curvature=rig.curvature(random)))
        goals.append(rig.goal(MoveFocus, goal))
        time.sleep(random.choice((0.0, random.uniform(0.0, 0.02), random.uniform(0.0, 0.3))))
    for _handle, result in goals:
        rig.wait(result.done, "the result of every goal", ANSWER_S)
    for _handle, result in goals[:-1]:
        _check_ended(record, result.result().result, ErrorCode.OK, ErrorCode.PREEMPTED)
    newest = goals[-1][1].result().result
    _check_ended(record, newest, ErrorCode.OK)
    if newest.error_code == ErrorCode.OK and not rig.near(newest.state.signals):
        lost(record, "an older goal stands in the place of the newest")


@fault("a goal of move_focus is cancelled after a newer request went another way; that one must stand", rounds=10)
def cancel_after_newer_request(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    handle, result = rig.goal(MoveFocus, MoveFocus.Goal(request=FocusRequest(curvature=rig.far_curvature(random))))
    time.sleep(random.uniform(0.0, 0.2))
    newer = rig.set_focus(rig.far_curvature(random))
    outcome = _end_somehow(rig, random, handle, result)
    _check_ended(record, outcome, ErrorCode.OK, ErrorCode.CANCELED, ErrorCode.PREEMPTED)
    rig.account_for(newer, record)


@fault("a move that waits for a degauss: cancelled, pre-empted or overtaken at any moment", rounds=6)
def conditioned_move_ended(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    request = FocusRequest(curvature=rig.curvature(random), mode=FocusRequest.MODE_CONDITIONED)
    handle, result = rig.goal(MoveFocus, MoveFocus.Goal(request=request))
    time.sleep(random.uniform(0.0, 3.0))
    way = random.choice(("cancel", "preempt", "overtake"))
    if way == "cancel":
        outcome = _end_somehow(rig, random, handle, result)
        _check_ended(record, outcome, ErrorCode.OK, ErrorCode.CANCELED)
        if outcome.error_code == ErrorCode.CANCELED:
            _check_at_rest(rig, record)
    elif way == "preempt":
        request = FocusRequest(curvature=rig.curvature(random), mode=FocusRequest.MODE_CONDITIONED)
        _handle, second = rig.goal(MoveFocus, MoveFocus.Goal(request=request))
        rig.wait(lambda: result.done() and second.done(), "both results", ANSWER_S)
        _check_ended(record, result.result().result, ErrorCode.OK, ErrorCode.PREEMPTED)
        _check_ended(record, second.result().result, ErrorCode.OK)
    else:
        newer = rig.set_focus(rig.curvature(random))
        rig.wait(result.done, "the result of the goal", ANSWER_S)
        _check_ended(record, result.result().result, ErrorCode.OK, ErrorCode.PREEMPTED)
        rig.account_for(newer, record)


@fault("converge cancelled at any moment, and requests that come meanwhile", rounds=6)
def loop_cancelled(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    goal = Converge.Goal(request=FocusRequest(curvature=rig.far_curvature(random)), max_maps=20, tolerance=1e-10)
    handle, result = rig.goal(Converge, goal)
    if random.random() < 0.5:
        rig.account_for(rig.set_focus(rig.curvature(random)), record, loop=True)
    outcome = _end_somehow(rig, random, handle, result)
    _check_ended(record, outcome, ErrorCode.OK, ErrorCode.CANCELED, ErrorCode.NOT_CONVERGED)
    _check_at_rest(rig, record)


@fault("a degauss that somebody else began when requests come: carried out after it, or refused in words", rounds=2)
def foreign_degauss(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    future = begin_degauss(rig, 10)
    rig.wait_moving(random.randint(2, 30))
    state = rig.set_focus(rig.curvature(random))
    rig.account_for(state, record)
    rig.wait_answer(future)


FAULTS: tuple[Fault, ...] = tuple(REGISTRY.values())[len(controller_faults.FAULTS) :]
