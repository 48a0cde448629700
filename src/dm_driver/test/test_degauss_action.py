"""What becomes of degauss goals that come, or are cancelled, at a bad moment."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from dm_common.errors import ErrorCode
from dm_driver.commands import degauss_action
from dm_driver.commands.command_gate import CommandGate
from dm_driver.commands.mirror_hold import MirrorHold, Operation
from dm_driver.moves import Kind, Move, Outcome


class Writer:
    """Its degauss ends as soon as it is to be left for another move."""

    def __init__(self, end: Outcome) -> None:
        self.end, self.turned_back, self.halted, self.begun = end, False, False, False

    def turn_back(self, move: Move, halt: bool) -> Move | None:
        self.turned_back, self.halted = not halt, halt
        move.finish(self.end)
        return move if halt else None


@pytest.fixture
def hold() -> MirrorHold:
    return MirrorHold(lambda: 0.0)


def carried_out(
    hold: MirrorHold, writer: Writer, monkeypatch: pytest.MonkeyPatch, overtaken: bool = False
) -> tuple[str, int, str]:
    """What the goal of the calibration ends in, which is cancelled as soon as it has begun."""
    goal = SimpleNamespace(holder="calibration", take_over=False)
    handle: Any = SimpleNamespace(request=goal, is_cancel_requested=False)
    server = SimpleNamespace(preempted=lambda _handle: overtaken)
    monkeypatch.setattr(degauss_action, "WorkerActionServer", lambda *_arguments, **_keywords: server)
    none: Any = None
    gate = CommandGate(hold, lambda _text, _took_over: None)
    action = degauss_action.DegaussAction(none, gate, {})

    def begin(*_arguments: Any) -> Any:
        writer.begun = handle.is_cancel_requested = True
        return writer, Move(Kind.DEGAUSS, none)

    monkeypatch.setattr(gate, "attempt", begin)
    return action._carry_out(handle)


@pytest.mark.parametrize("holder", ["", "calibration"])
def test_who_was_superseded_hears_how_to_keep_others_off(monkeypatch: pytest.MonkeyPatch, holder: str) -> None:
    none: Any = None
    handle: Any = SimpleNamespace(
        request=SimpleNamespace(holder=holder, take_over=False), is_cancel_requested=False, publish_feedback=print
    )
    server = SimpleNamespace(preempted=lambda _handle: False)
    monkeypatch.setattr(degauss_action, "WorkerActionServer", lambda *_arguments, **_keywords: server)
    gate = CommandGate(MirrorHold(lambda: 0.0), lambda _text, _took_over: None)
    move = Move(Kind.DEGAUSS, none)
    move.finish(Outcome.SUPERSEDED)
    monkeypatch.setattr(gate, "attempt", lambda *_arguments: (none, move))
    outcome, code, text = degauss_action.DegaussAction(none, gate, {})._carry_out(handle)
    assert (outcome, code) == ("abort", ErrorCode.PREEMPTED)
    assert ("hold_mirror keeps other commands away" in text) == (not holder)


def test_a_goal_that_was_overtaken_moves_nothing(hold: MirrorHold, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = Writer(Outcome.REACHED)
    assert carried_out(hold, writer, monkeypatch, overtaken=True)[:2] == ("abort", ErrorCode.PREEMPTED)
    assert not writer.begun


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        (Outcome.REACHED, ("succeed", ErrorCode.OK)),
        (Outcome.LINK_LOST, ("abort", ErrorCode.ELECTRONICS_UNREACHABLE)),
        (Outcome.SUPERSEDED, ("canceled", ErrorCode.CANCELED)),
    ],
)
def test_a_cancel_that_comes_too_late_reports_how_the_degauss_ended(
    hold: MirrorHold, monkeypatch: pytest.MonkeyPatch, end: Outcome, expected: tuple[str, int]
) -> None:
    assert carried_out(hold, Writer(end), monkeypatch)[:2] == expected


def test_who_lost_the_mirror_does_not_move_it_by_a_cancel(hold: MirrorHold, monkeypatch: pytest.MonkeyPatch) -> None:
    hold.handle(Operation.HOLD, "calibration")
    hold.handle(Operation.TAKE_OVER, "operator")
    writer = Writer(Outcome.REACHED)
    outcome, code, text = carried_out(hold, writer, monkeypatch)
    assert (outcome, code) == ("canceled", ErrorCode.CANCELED) and "operator" in text
    assert writer.halted and not writer.turned_back
