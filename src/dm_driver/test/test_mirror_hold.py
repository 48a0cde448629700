"""One owner of the mirror at a time."""

from __future__ import annotations

import pytest

from dm_common.errors import ErrorCode, Refusal
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
    hold.ask(Operation.HOLD, "calibration", "cancel its action calibrate to end it", duration=95.0)
    return hold


def refused(code: ErrorCode) -> pytest.RaisesExc[Refusal]:
    return pytest.RaisesExc(Refusal, check=lambda error: error.error_code == code)


def test_others_hear_who_holds_it_how_long_and_how_to_end_it(hold: MirrorHold, clock: Clock) -> None:
    clock.now += 2.0
    with pytest.raises(Refusal, match=r"calibration has held .* 2 s, about 93 s to go: cancel its action") as caught:
        hold.check("", take_over=False)
    assert caught.value.error_code == ErrorCode.BUSY
    assert not hold.check("calibration", take_over=False)
    with refused(ErrorCode.BUSY):
        hold.ask(Operation.HOLD, "autofocus")


def test_it_ends_soon_after_its_holder_died(hold: MirrorHold, clock: Clock) -> None:
    clock.now += 0.9 * LEASE_S
    hold.ask(Operation.RENEW, "calibration")
    clock.now += 0.9 * LEASE_S
    assert hold.holder == "calibration"
    clock.now += 0.2 * LEASE_S
    assert hold.holder == hold.sentence == "" and not hold.check("", take_over=False)


def test_who_lost_it_does_not_get_it_back_by_renewing(hold: MirrorHold) -> None:
    assert hold.check("", take_over=True)
    hold.evict("")
    with refused(ErrorCode.PREEMPTED):
        hold.ask(Operation.RENEW, "calibration")
    with refused(ErrorCode.PREEMPTED):
        hold.check("calibration", take_over=False)
    hold.ask(Operation.HOLD, "calibration")
    hold.ask(Operation.TAKE_OVER, "operator")
    with refused(ErrorCode.PREEMPTED):
        hold.ask(Operation.RENEW, "calibration")
    hold.ask(Operation.RELEASE, "operator")
    assert hold.holder == ""


def test_a_driver_that_was_restarted_takes_a_renewal_for_a_hold(clock: Clock) -> None:
    hold = MirrorHold(clock)
    hold.ask(Operation.RENEW, "calibration")
    assert hold.holder == "calibration"


@pytest.mark.parametrize(
    ("code", "fields"),
    [
        (ErrorCode.OUT_OF_RANGE, {"operation": 4}),
        (ErrorCode.INVALID_ARGUMENT, {"holder": " "}),
        (ErrorCode.NOT_FINITE, {"lease": float("nan")}),
        (ErrorCode.OUT_OF_RANGE, {"lease": -1.0}),
        (ErrorCode.NOT_FINITE, {"duration": float("inf")}),
    ],
)
def test_fields_that_cannot_be(clock: Clock, code: ErrorCode, fields: dict[str, object]) -> None:
    with refused(code):
        MirrorHold(clock).ask(**{"operation": Operation.HOLD, "holder": "operator"} | fields)  # type: ignore[arg-type]


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
        hold.ask(Operation.HOLD, "autofocus")
        hold.ask(Operation.RELEASE, "autofocus")
    if between == "nobody":
        hold.ask(Operation.RENEW, "calibration")
        hold.evict("calibration")
        assert hold.holder == "calibration"
    else:
        with refused(ErrorCode.PREEMPTED):
            hold.ask(Operation.RENEW, "calibration")
        hold.ask(Operation.HOLD, "calibration")
        hold.ask(Operation.RENEW, "calibration")
