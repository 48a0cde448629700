"""One owner of the mirror at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest
from dm_msgs.srv import HoldMirror

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros import clients
from dm_driver.commands.command_gate import CommandGate
from dm_driver.commands.mirror_hold import LEASE_S, MirrorHold, Operation


class Clock:
    """Steady time that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def hold(clock: Clock) -> MirrorHold:
    hold = MirrorHold(clock)
    hold.handle(Operation.HOLD, "calibration", "cancel its action calibrate to end it", duration=95.0)
    return hold


@contextmanager
def refused(code: ErrorCode) -> Iterator[None]:
    with pytest.raises(Refusal) as caught:
        yield
    assert caught.value.error_code == code


def test_a_run_that_is_late_is_not_about_to_end(clock: Clock) -> None:
    hold = MirrorHold(clock)
    hold.handle(Operation.HOLD, "calibration", duration=1.0)
    clock.now += 2.0
    with pytest.raises(Refusal, match=r"for 2 s; take_over"):
        hold.check("", take_over=False)


def test_others_hear_who_holds_it_how_long_and_how_to_end_it(hold: MirrorHold, clock: Clock) -> None:
    clock.now += 2.0
    with pytest.raises(Refusal, match=r"calibration has held .* 2 s, about 93 s to go: cancel its action") as caught:
        hold.check("", take_over=False)
    assert caught.value.error_code == ErrorCode.BUSY
    assert not hold.check("calibration", take_over=False)
    with refused(ErrorCode.BUSY):
        hold.handle(Operation.HOLD, "autofocus")


def test_a_renewal_keeps_what_it_does_not_say_anew(hold: MirrorHold, clock: Clock) -> None:
    clock.now += 1.0
    hold.handle(Operation.RENEW, "calibration")
    assert "about 94 s to go: cancel its action" in hold.sentence
    hold.handle(Operation.RENEW, "calibration", "the last maps", duration=11.0, lease=60.0)
    assert "about 10 s to go: the last maps" in hold.sentence
    hold.handle(Operation.RENEW, "calibration")
    clock.now += 59.0
    assert hold.sentence.endswith("60 s: the last maps; take_over takes it from there")
    clock.now += 2.0
    assert not hold.holder
    hold.handle(Operation.RENEW, "calibration")  # late, and nobody came between
    assert hold.sentence.startswith("calibration has held the mirror for 62 s: the last maps")


def test_it_ends_soon_after_its_holder_died(hold: MirrorHold, clock: Clock) -> None:
    clock.now += 0.9 * LEASE_S
    hold.handle(Operation.RENEW, "calibration")
    clock.now += 0.9 * LEASE_S
    assert hold.holder == "calibration"
    clock.now += 0.2 * LEASE_S
    assert hold.holder == hold.sentence == "" and not hold.check("", take_over=False)


def test_who_lost_it_does_not_get_it_back_by_renewing(hold: MirrorHold) -> None:
    assert hold.check("", take_over=True)
    hold.evict("")
    with refused(ErrorCode.PREEMPTED):
        hold.handle(Operation.RENEW, "calibration")
    with refused(ErrorCode.PREEMPTED):
        hold.check("calibration", take_over=False)
    hold.handle(Operation.HOLD, "calibration")
    hold.handle(Operation.TAKE_OVER, "operator")
    with refused(ErrorCode.PREEMPTED):
        hold.handle(Operation.RENEW, "calibration")
    hold.handle(Operation.RELEASE, "operator")
    assert hold.holder == ""
    hold.handle(Operation.HOLD, "autofocus")
    hold.evict("")  # what somebody else loses gives nothing back
    with refused(ErrorCode.PREEMPTED):
        hold.handle(Operation.RENEW, "calibration")


@pytest.mark.parametrize("way", ["release", "command"])
def test_who_lost_it_is_heard_again_after_giving_it_back_or_taking_it(hold: MirrorHold, way: str) -> None:
    hold.handle(Operation.TAKE_OVER, "operator")
    with refused(ErrorCode.PREEMPTED):
        hold.check("calibration", take_over=False)
    if way == "release":
        hold.handle(Operation.RELEASE, "operator")
        hold.handle(Operation.RELEASE, "calibration")
    else:
        assert hold.check("calibration", take_over=True)
        hold.evict("calibration", take_over=True)
    assert not hold.check("calibration", take_over=False)


def test_a_driver_that_was_restarted_takes_a_renewal_for_a_hold(clock: Clock) -> None:
    hold = MirrorHold(clock)
    hold.handle(Operation.RENEW, "calibration")
    assert hold.holder == "calibration"


@pytest.mark.parametrize(
    ("code", "fields"),
    [
        (ErrorCode.UNKNOWN_NAME, {"operation": "keep"}),
        (ErrorCode.INVALID_ARGUMENT, {"holder": " "}),
        (ErrorCode.NOT_FINITE, {"lease": float("nan")}),
        (ErrorCode.OUT_OF_RANGE, {"lease": -1.0}),
        (ErrorCode.OUT_OF_RANGE, {"lease": 1e-9}),
        (ErrorCode.NOT_FINITE, {"duration": float("inf")}),
        (ErrorCode.OUT_OF_RANGE, {"duration": 2e9}),
        (ErrorCode.INVALID_LENGTH, {"holder": "x" * 5000}),
        (ErrorCode.INVALID_LENGTH, {"purpose": "x" * 5000}),
    ],
)
def test_fields_that_cannot_be(clock: Clock, code: ErrorCode, fields: dict[str, object]) -> None:
    with refused(code):
        MirrorHold(clock).handle(**{"operation": Operation.HOLD, "holder": "operator"} | fields)


@pytest.mark.parametrize("between", ["nobody", "command", "own command, then another", "hold"])
def test_a_hold_that_lapsed_is_renewed_only_where_nobody_moved_the_mirror(
    hold: MirrorHold, clock: Clock, between: str
) -> None:
    clock.now += 1.1 * LEASE_S
    if between.startswith("own"):
        hold.evict("calibration")
    if between.endswith(("command", "another")):
        assert not hold.check("", take_over=False)
        hold.evict("")
    elif between == "hold":
        hold.handle(Operation.HOLD, "autofocus")
        hold.handle(Operation.RELEASE, "autofocus")
    if between == "nobody":
        hold.handle(Operation.RENEW, "calibration")
        hold.evict("calibration")
        assert hold.holder == "calibration"
    else:
        with refused(ErrorCode.PREEMPTED):
            hold.handle(Operation.RENEW, "calibration")
        hold.handle(Operation.HOLD, "calibration")
        hold.handle(Operation.RENEW, "calibration")


class Node:
    """Of whoever holds a mirror by `hold_mirror`, without ROS between."""

    def create_client(self, _kind: Any, _name: str) -> None:
        return None

    def create_timer(self, *_arguments: Any, **_keywords: Any) -> Any:
        return SimpleNamespace(reset=lambda: None, cancel=lambda: None)


@pytest.fixture
def run(hold: MirrorHold, monkeypatch: pytest.MonkeyPatch) -> clients.MirrorHolder:
    """Of the node `loop`, while the calibration holds the mirror."""

    def call(_client: Any, request: Any, *_waits: Any) -> HoldMirror.Response:
        response = HoldMirror.Response()
        try:
            hold.handle(request.operation, request.holder, request.purpose, request.duration, request.lease)
        except Refusal as refusal:
            response.error_code, response.message = refusal.error_code, str(refusal)
        response.holder = hold.holder
        return response

    monkeypatch.setattr(clients, "call", call)
    node: Any = Node()
    return clients.MirrorHolder(node, "loop")


def asked(holder: str = "", take_over: bool = False) -> Any:
    return SimpleNamespace(holder=holder, take_over=take_over)


def test_a_hold_on_a_driver_that_is_gone_is_given_up_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, bool]] = []

    def call(_client: Any, request: Any, _timeout_s: float, cancelled: Any) -> HoldMirror.Response:
        calls.append((request.operation, cancelled()))
        return HoldMirror.Response()

    monkeypatch.setattr(clients, "call", call)
    node: Any = Node()
    with clients.MirrorHolder(node, "loop", lambda: True).held(asked(), "a loop", 0.0, 1.0):
        pass
    assert calls == [(Operation.HOLD, False), (Operation.RELEASE, True)]


@pytest.mark.parametrize("take_over", [False, True])
def test_a_run_goes_on_in_the_name_of_who_asks_where_they_hold_it(
    hold: MirrorHold, run: clients.MirrorHolder, take_over: bool
) -> None:
    with run.held(asked("calibration", take_over), "a loop", 0.0, 1.0):
        assert run.holder == hold.holder == "calibration"
    assert hold.holder == "calibration" and "cancel its action" in hold.sentence
    hold.handle(Operation.RELEASE, "calibration")
    with run.held(asked("calibration"), "a loop", 0.0, 1.0):
        assert run.holder == hold.holder == "loop"
    assert hold.holder == ""


def test_a_run_takes_over_what_somebody_else_holds_only_where_it_is_asked_to(
    hold: MirrorHold, run: clients.MirrorHolder
) -> None:
    with refused(ErrorCode.BUSY), run.held(asked(), "a loop", 0.0, 1.0):
        pass
    assert hold.holder == "calibration"
    with run.held(asked(take_over=True), "a loop", 0.0, 1.0):
        assert run.holder == hold.holder == "loop"
        with refused(ErrorCode.PREEMPTED):
            hold.handle(Operation.RENEW, "calibration")


def test_nobody_is_granted_the_mirror_while_a_command_of_another_is_on_its_way() -> None:
    """It would lose the mirror to that command at once, and its run with it."""
    hold = MirrorHold(time.monotonic)
    gate = CommandGate(hold, lambda _text, _took_over: None)
    gate.writer = gate.configuration = cast(Any, object())
    asking = threading.Thread(target=hold.handle, args=(Operation.HOLD, "calibration"))

    def carry_out(_writer: Any, _configuration: Any) -> str:
        asking.start()
        asking.join(0.1)
        return "moves"

    assert gate.attempt("set_signals", SimpleNamespace(holder="", take_over=False), carry_out) == "moves"
    asking.join()
    hold.handle(Operation.RENEW, "calibration")
    assert hold.holder == "calibration"
