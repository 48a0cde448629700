"""What the driver logs of its link: each change once, an error only where something is wrong."""

from __future__ import annotations

from dm_driver.driver_health import AWAIT_S, LinkLog
from dm_driver.moves import WriterState


def state(fault: str) -> WriterState:
    return WriterState(not fault, True, None, None, None, None, 0, 0, False, 0, 0, None, fault)


def test_a_unit_that_comes_later_is_no_error() -> None:
    log = LinkLog(0.0)
    assert log.news(state("cannot open EDAC40: refused"), 0.1) == (
        "info",
        "cannot open EDAC40: refused; waiting for the drive electronics",
    )
    assert log.news(state("cannot open EDAC40: timed out"), 1.1) is None
    assert log.news(state(""), 2.0) == ("info", "the link to the drive electronics is up")
    assert log.news(state(""), 2.5) is None and log.news(state("closed"), 3.0) is None


def test_a_lost_link_and_a_unit_that_never_comes_are() -> None:
    log = LinkLog(0.0)
    log.news(state(""), 0.1)
    assert log.news(state("the unit closed the connection"), 1.0) == (
        "error",
        "the unit closed the connection; trying again",
    )
    assert log.news(state("the unit closed the connection"), 1.5) is None
    assert log.news(state(""), 2.0) == ("info", "the link to the drive electronics is up")
    missing = LinkLog(0.0)
    assert missing.news(state("refused"), 0.1) is not None
    assert missing.news(state("refused"), AWAIT_S + 0.1) == ("error", "refused; trying again")
    assert missing.news(state("refused"), AWAIT_S + 0.6) is None
