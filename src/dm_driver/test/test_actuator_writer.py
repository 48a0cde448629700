"""The writer's thread against a unit on a real TCP socket, judged by the frames that arrive."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_common.errors import ErrorCode, Refusal
from dm_common.geometry import hexagonal_positions, neighbour_pairs
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.degauss import degauss_move
from dm_driver.electronics import Edac40Tcp, Edac40Udp
from dm_driver.electronics.base import DriveElectronics, ElectronicsSettings
from dm_driver.last_shape import LastShape
from dm_driver.moves import Kind, Move, Outcome, WriterState
from dm_driver.output.volts import VoltScale
from dm_driver.output.wiring import OutputStage, wiring_table
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter
from drive_unit_servers import Edac40TcpUnit, Edac40UdpUnit, signals_of
from waiting import wait_until

PAIRS = neighbour_pairs(*hexagonal_positions(37))
SCALE = VoltScale(65535, -6.0, 6.0, 80.0, 0.0, 300.0)
CODE = SCALE.resolution


@pytest.fixture
def unit() -> Iterator[Edac40TcpUnit]:
    with Edac40TcpUnit() as server:
        assert isinstance(server, Edac40TcpUnit)
        yield server


def limits(slew_rate: float) -> DriverLimits:
    return DriverLimits(-1, 1, PAIRS, 1.0, actuators=37, step=0.1, slew_rate=slew_rate)


@contextmanager
def started_writer(
    unit: Edac40TcpUnit | Edac40UdpUnit,
    slew_rate: float = 1000.0,
    electronics: type[DriveElectronics] = Edac40Tcp,
    **arguments: Any,
) -> Iterator[tuple[ActuatorWriter, list[tuple[WriterState, bool]]]]:
    """A writer that is not enabled yet, and what it told."""
    reports: list[tuple[WriterState, bool]] = []
    writer = ActuatorWriter(
        electronics(ElectronicsSettings("127.0.0.1", unit.port, timeout_s=0.5)),
        OutputStage(SCALE, wiring_table("trihex", [], 37, 40), 40),
        SafetyLimiter(limits(slew_rate)),
        np.full(37, -1.0),
        listener=lambda state, edge: reports.append((state, edge)),
        **arguments,
    )
    writer.start()
    try:
        yield writer, reports
    finally:
        assert writer.stop()


@contextmanager
def running_writer(
    unit: Edac40TcpUnit | Edac40UdpUnit, *arguments: Any, **keywords: Any
) -> Iterator[tuple[ActuatorWriter, list[tuple[WriterState, bool]]]]:
    with started_writer(unit, *arguments, **keywords) as (writer, reports):
        assert writer.wait_for_link(5)
        assert writer.enable(5)
        yield writer, reports


def shape(value: float) -> np.ndarray:
    return np.full(37, value)


def degauss(writer: ActuatorWriter, amplitude: float, steps: int, end: np.ndarray) -> Move:
    return writer.submit(degauss_move(limits(writer._limiter.limits.slew_rate), amplitude, steps, end))


def refused(action: Callable[[], Any]) -> int:
    with pytest.raises(Refusal) as caught:
        action()
    return caught.value.error_code


def test_nothing_is_written_before_enable_and_then_the_safe_shape_first(unit: Edac40TcpUnit) -> None:
    writer = ActuatorWriter(
        Edac40Tcp(ElectronicsSettings("127.0.0.1", unit.port)),
        OutputStage(SCALE, wiring_table("trihex", [], 37, 40), 40),
        SafetyLimiter(DriverLimits(actuators=37)),
        shape(-0.25),
    )
    writer.start()
    assert writer.wait_for_link(5)
    assert refused(lambda: writer.command(shape(0))) is ErrorCode.DRIVER_INACTIVE
    assert unit.raw == b""
    assert writer.state().applied is None
    assert writer.enable(5)
    wait_until(lambda: unit.frames)
    assert signals_of(unit.frames) == pytest.approx(-0.25, abs=CODE)
    assert writer.state().sequence == 1
    assert writer.stop()


def test_a_small_command_is_one_frame_and_a_large_one_a_ramp(unit: Edac40TcpUnit) -> None:
    with running_writer(unit) as (writer, reports):
        assert writer.command(shape(-0.95)).wait(5) is Outcome.REACHED
        wait_until(lambda: len(unit.frames) == 2)
        move = writer.command(shape(0.9))
        assert move.wait(5) is Outcome.REACHED
        wait_until(lambda: len(unit.frames) == 2 + 19)
    on_wire = signals_of(unit.frames)
    assert on_wire[1] == pytest.approx(-0.95, abs=CODE)
    assert on_wire[-1] == pytest.approx(0.9, abs=CODE)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    state, edge = reports[-1]
    assert not state.link_up or (edge and state.moving is None)
    ramp = [edge for state, edge in reports if 2 < state.sequence <= 21]
    assert ramp == [True, *[False] * 17, True]  # first and last are edges


def test_the_slew_rate_holds(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=20.0) as (writer, _reports):
        begun = time.monotonic()
        writer.command(shape(0.0)).wait(5)
        writer.command(shape(-0.5)).wait(5)
        assert time.monotonic() - begun >= (1.5 - 0.1) / 20.0


def test_a_newer_command_takes_over_in_the_middle_of_a_ramp(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=10.0) as (writer, _reports):
        first = writer.command(shape(1.0))
        wait_until(lambda: len(unit.frames) > 4)
        second = writer.command(shape(-1.0))
        assert first.wait(5) is Outcome.SUPERSEDED
        assert second.wait(5) is Outcome.REACHED
        frames = writer.state().sequence
        wait_until(lambda: len(unit.frames) == frames)
    on_wire = signals_of(unit.frames)
    assert on_wire.max() < 0.9
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    assert on_wire[-1] == pytest.approx(-1.0, abs=CODE)


@pytest.mark.slow
def test_a_correction_that_something_overtook_is_left_out(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=10.0) as (writer, _reports):
        assert writer.command(shape(-0.5)).wait(5) is Outcome.REACHED
        turns = writer.state().turns
        correction = writer.correct(shape(-0.49), turns)
        assert correction is not None and correction.wait(5) is Outcome.REACHED
        assert writer.correct(shape(-0.48), turns) is None  # decided before the last one stood

        move = writer.command(shape(0.5))
        assert writer.correct(shape(-0.48), turns + 1) is None  # decided before the move began
        assert move.wait(5) is Outcome.REACHED
        cycle = degauss(writer, 0.0, 6, shape(0.0))
        assert writer.correct(shape(0.49), turns + 2) is None
        assert cycle.wait(20) is Outcome.REACHED
        assert writer.counters.overtaken == 3
        assert writer.state().requested == pytest.approx(shape(0.0))


def test_random_commands_at_random_moments_break_no_limit_on_the_wire(unit: Edac40TcpUnit) -> None:
    generator = np.random.default_rng(7)
    limiter = SafetyLimiter(DriverLimits(-1, 1, PAIRS, 1.0, actuators=37))
    with running_writer(unit, slew_rate=200.0) as (writer, _reports):
        last = None
        for number in range(60):
            try:
                last = writer.command(limiter.check_shape(generator.uniform(-0.6, 0.6, 37)))
            except Refusal as refusal:
                assert refusal.error_code is ErrorCode.NEIGHBOUR_DIFFERENCE
            if number == 30:
                degauss(writer, 0.0, 6, shape(0.0))
            time.sleep(generator.uniform(0, 0.01))
        assert last is not None and last.wait(5) is Outcome.REACHED
        wait_until(lambda: len(unit.frames) == writer.state().sequence)
        requested = writer.state().requested
    on_wire = signals_of(unit.frames)
    assert len(on_wire) > 30
    assert np.abs(on_wire).max() <= 1.0
    assert np.abs(on_wire[:, PAIRS[:, 0]] - on_wire[:, PAIRS[:, 1]]).max() <= 1.0 + CODE
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    assert on_wire[-1] == pytest.approx(requested, abs=CODE)


def test_degauss_on_the_wire(unit: Edac40TcpUnit) -> None:
    with running_writer(unit) as (writer, _reports):
        assert not writer.state().history_known
        move = degauss(writer, 0.5, 10, shape(0.2))
        assert move.wait(10) is Outcome.REACHED
        assert not writer.state().history_known  # wider swings than 0.5 are still remembered
        wait_until(lambda: len(unit.frames) == writer.state().sequence)
    one = signals_of(unit.frames)
    assert np.ptp(one, axis=1).max() <= CODE  # all together
    level = one[1:-1, 0]
    turns = level[1:-1][np.sign(np.diff(level))[1:] != np.sign(np.diff(level))[:-1]]
    # The first point, -0.5, is no turn: the mirror comes up from -1.
    expected = [(-1) ** (k + 1) * 0.5 * (1 - k / 10) for k in range(1, 10)]
    assert turns[:9] == pytest.approx(expected, abs=CODE)


def test_a_full_degauss_makes_the_history_known_while_every_write_goes_through(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=1e4) as (writer, _reports):
        assert degauss(writer, 0.0, 4, shape(0.2)).wait(10) is Outcome.REACHED
        assert not writer.state().history_known, "an eighth of the first half-swing may be left"
        assert degauss(writer, 0.0, 10, shape(0.2)).wait(10) is Outcome.REACHED
        assert writer.state().history_known and writer.state().degausses == 1
        assert writer.command(shape(0.25)).wait(5) is Outcome.REACHED
        assert writer.state().history_known


def test_every_turn_is_counted_and_told_with_its_place(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=20.0) as (writer, reports):
        assert writer.command(shape(0.5)).wait(5) is Outcome.REACHED
        assert writer.state().turns == 1 and writer.state().turned_at == pytest.approx(0.5, abs=CODE)
        left = writer.command(shape(-0.9))
        wait_until(lambda: (applied := writer.state().applied) is not None and applied[0] < 0.2)
        assert writer.command(shape(0.9)).wait(5) is Outcome.REACHED
        assert left.wait(5) is Outcome.SUPERSEDED
        assert writer.state().turns == 3
    lowest = min(state.applied[0] for state, _ in reports if state.applied is not None and state.turns >= 1)
    places = {state.turns: state.turned_at[0] for state, _ in reports if state.turned_at is not None}
    assert places[2] == pytest.approx(lowest, abs=CODE) and places[3] == pytest.approx(0.9, abs=CODE)


@pytest.mark.slow
def test_a_move_of_one_step_that_takes_over_hides_no_turn(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=2.0) as (writer, reports):
        writer.command(shape(0.9))
        wait_until(lambda: (applied := writer.state().applied) is not None and applied[0] > -0.5)
        applied = writer.state().applied
        assert applied is not None and writer.command(applied - 0.01).wait(5) is Outcome.REACHED
        assert writer.state().turns == 2
    assert {0, 1, 2} <= {state.turns for state, edge in reports if edge}


def test_a_command_cancels_a_degauss_and_leaves_the_history_unknown(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=40.0) as (writer, _reports):
        assert degauss(writer, 0.1, 2, shape(0.0)).wait(5) is Outcome.REACHED
        move = degauss(writer, 0.0, 100, shape(0.0))
        wait_until(lambda: writer.state().moving is Kind.DEGAUSS and not writer.state().history_known)
        command = writer.command(shape(0.3))
        assert move.wait(5) is Outcome.SUPERSEDED
        assert command.wait(5) is Outcome.REACHED
        assert not writer.state().history_known


@pytest.mark.slow
def test_watchdog_goes_to_the_safe_shape_once(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, watchdog_s=0.6) as (writer, _reports):
        assert writer.command(shape(0.0)).wait(5) is Outcome.REACHED
        wait_until(lambda: signals_of(unit.frames[-1:])[0] == pytest.approx(-1.0, abs=CODE), what="safe shape")
        frames = len(unit.frames)
        time.sleep(0.9)
        assert len(unit.frames) == frames
        assert writer.command(shape(-0.9)).wait(5) is Outcome.REACHED


@pytest.mark.slow
def test_a_degauss_turns_back_to_the_shape_before_unless_something_newer_came(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=20.0) as (writer, _reports):
        assert writer.command(shape(0.3)).wait(5) is Outcome.REACHED
        move = degauss(writer, 0.0, 100, shape(0.0))
        wait_until(lambda: move.begun > 2)
        back = writer.turn_back(move)
        assert back is not None and back.wait(5) is Outcome.REACHED
        wait_until(lambda: np.allclose(signals_of(unit.frames)[-1], 0.3, atol=CODE))
        assert not writer.state().history_known
        first = degauss(writer, 0.0, 100, shape(0.0))
        wait_until(lambda: first.begun > 2)
        back = writer.turn_back(degauss(writer, 0.0, 100, shape(0.1)))
        assert back is not None and back.target == pytest.approx(shape(0.3))  # no degauss has ended
        assert back.wait(5) is Outcome.REACHED
        move = degauss(writer, 0.0, 100, shape(0.0))
        newer = writer.command(shape(-0.2))
        assert writer.turn_back(move) is None and newer.wait(5) is Outcome.REACHED


def test_a_degauss_that_halts_swings_no_more(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=10.0) as (writer, _):
        move = degauss(writer, 1.0, 20, shape(0.0))
        wait_until(lambda: len(unit.frames) > 10)
        there = writer.turn_back(move, halt=True)
        assert there is not None and there.wait(5) is Outcome.REACHED and move.wait(5) is Outcome.SUPERSEDED
        wait_until(lambda: len(unit.frames) == writer.state().sequence)
        seen = signals_of(unit.frames)
        assert np.abs(seen[-1] - seen[-2]).max() <= 0.1 + CODE
        assert writer.state().moving is None and writer.turn_back(move, halt=True) is None


def test_a_degauss_is_bounded() -> None:
    with pytest.raises(
        Refusal, match=r"steps = 9000: would take 450 s at limits.slew_rate = 20 1/s, must be at most 180 s"
    ) as caught:
        degauss_move(limits(20.0), 0.0, 9000, shape(0.0), duration_max=180.0)
    assert caught.value.error_code == ErrorCode.OUT_OF_RANGE


@pytest.mark.parametrize(("amplitude", "steps"), [(1.01, 10), (0.5, 0), (1e-4, 100_000)])
def test_an_impossible_degauss_is_refused(amplitude: float, steps: int) -> None:
    assert refused(lambda: degauss_move(limits(20.0), amplitude, steps, shape(0.0))) is ErrorCode.OUT_OF_RANGE


@pytest.mark.slow
def test_a_degauss_longer_than_the_watchdog_is_finished(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=40.0, watchdog_s=0.1) as (writer, _reports):
        assert degauss(writer, 0.5, 20, shape(0.0)).wait(10) is Outcome.REACHED


@pytest.mark.slow
def test_link_loss_in_a_ramp_and_return(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=4.0) as (writer, reports):
        degauss(writer, 0.05, 1, shape(-0.9)).wait(5)
        move = writer.command(shape(0.6))
        wait_until(lambda: writer.state().sequence > 15)
        unit.unplug()
        assert move.wait(5) is Outcome.LINK_LOST
        lost = writer.state()
        assert not lost.link_up and not lost.history_known and lost.moving is None
        assert "EDAC40 at 127.0.0.1" in lost.fault
        assert refused(lambda: writer.command(shape(0.0))) is ErrorCode.ELECTRONICS_UNREACHABLE
        assert lost.applied is not None and lost.applied.max() < 0.6
        before = len(unit.frames)
        unit.plug()
        wait_until(lambda: writer.state().link_up)
        wait_until(lambda: len(unit.frames) > before)
        assert signals_of(unit.frames[before : before + 1])[0] == pytest.approx(lost.applied, abs=1e-9)
        assert writer.state().fault == ""
        assert (writer.counters.link_losses, writer.counters.reconnects) == (1, 1)
        assert writer.command(shape(-1.0)).wait(10) is Outcome.REACHED
    assert [state.link_up for state, _edge in reports].count(False) >= 1


@pytest.mark.slow
def test_a_unit_that_restarts_while_idle_gets_the_shape_again(unit: Edac40TcpUnit) -> None:
    with running_writer(unit) as (writer, _reports):
        assert writer.command(shape(-0.92)).wait(5) is Outcome.REACHED
        wait_until(lambda: len(unit.frames) == 2)
        unit.drop_client()
        wait_until(lambda: len(unit.frames) == 3, what="the shape again")
        assert signals_of(unit.frames)[2] == pytest.approx(-0.92, abs=CODE)


def test_disable_ramps_to_the_safe_shape_and_refuses_commands(unit: Edac40TcpUnit) -> None:
    with running_writer(unit) as (writer, _reports):
        writer.command(shape(0.5)).wait(5)
        moving = writer.command(shape(-0.5))
        assert writer.disable(5) is Outcome.REACHED
        assert moving.wait(0) in (Outcome.SUPERSEDED, Outcome.REACHED)
        assert refused(lambda: writer.command(shape(0.0))) is ErrorCode.DRIVER_INACTIVE
        sequence = writer.state().sequence
        wait_until(lambda: len(unit.frames) == sequence)
        on_wire = signals_of(unit.frames)
        assert on_wire[-1] == pytest.approx(-1.0, abs=CODE)
        assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
        assert writer.enable(5)


@pytest.mark.slow
def test_a_unit_slower_than_the_limits_is_waited_for_on_the_way_to_the_safe_shape(unit: Edac40TcpUnit) -> None:
    class Slow(Edac40Tcp):
        def _do_write(self, codes: np.ndarray, wired: np.ndarray) -> None:
            time.sleep(0.03)
            super()._do_write(codes, wired)

    with running_writer(unit, electronics=Slow) as (writer, _reports):
        assert writer.command(shape(0.5)).wait(5) is Outcome.REACHED
        assert writer.disable(0.2) is Outcome.REACHED
        wait_until(lambda: signals_of(unit.frames[-1:]) == pytest.approx(-1.0, abs=CODE))


class Counting(Edac40Tcp):
    """Counts how often the link was looked at, and tried: at the second of two tries the first one has failed."""

    tries = checks = 0

    def _do_check(self) -> None:
        self.checks += 1
        super()._do_check()

    def _do_open(self) -> None:
        self.tries += 1
        super()._do_open()


def fail_to_connect(writer: ActuatorWriter) -> None:
    """Wait until the link was tried in vain since the call."""
    electronics = writer._electronics
    assert isinstance(electronics, Counting)
    tries = electronics.tries
    wait_until(lambda: electronics.tries >= tries + 2, what="a link that was tried in vain")


def ramp_to_safe_shape(unit: Edac40TcpUnit, begins_at: float, since: int = 0) -> None:
    """Wait until a ramp to the safe shape has arrived, and judge the frames from number `since` on."""
    arrived = pytest.approx(-1.0, abs=CODE)
    wait_until(lambda: len(unit.frames) > since and signals_of(unit.frames[-1:]) == arrived, what="safe shape")
    on_wire = signals_of(unit.frames[since:])
    assert on_wire[0] == pytest.approx(begins_at, abs=CODE)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE


@pytest.mark.slow
def test_the_safe_shape_is_reached_although_the_link_comes_late(unit: Edac40TcpUnit, tmp_path: Path) -> None:
    path = tmp_path / "unit.shape"
    LastShape(path, 37).note(
        replace(SCALE, volts_max=400.0).exact_codes(shape(0.35))
    )  # 270 V, by a driver that was killed
    unit.unplug()
    with started_writer(unit, electronics=Counting, last=LastShape(path, 37)) as (writer, _reports):
        assert not writer.enable(0.0)
        fail_to_connect(writer)
        assert writer.state().moving is None
        unit.plug()
        ramp_to_safe_shape(unit, 0.8)
        assert writer.command(shape(0.5)).wait(5) is Outcome.REACHED
        unit.unplug()
        wait_until(lambda: not writer.state().link_up)
        assert writer.disable(5) is Outcome.LINK_LOST
        assert not writer.enable(0.0)
        fail_to_connect(writer)
        frames = len(unit.frames)
        unit.plug()
        ramp_to_safe_shape(unit, 0.5, frames)


@pytest.mark.slow
@pytest.mark.parametrize("commanded", [False, True])
def test_a_link_lost_on_the_way_to_the_safe_shape(unit: Edac40TcpUnit, tmp_path: Path, commanded: bool) -> None:
    """The way goes on, unless an accepted command took its place: then the shape stays where the link was lost."""
    path = tmp_path / "unit.shape"
    LastShape(path, 37).note(SCALE.exact_codes(shape(0.8)))
    with started_writer(unit, slew_rate=1.0, last=LastShape(path, 37)) as (writer, _reports):
        assert writer.wait_for_link(5)
        writer.enable(0.0)
        wait_until(lambda: len(unit.frames) > 2)
        move = writer.command(shape(-0.9)) if commanded else None
        unit.unplug()
        wait_until(lambda: not writer.state().link_up)
        lost, frames = writer.state(), len(unit.frames)
        assert lost.applied is not None and -1.0 + CODE < lost.applied[0] < 0.9 - CODE
        unit.plug()
        if move is None:
            ramp_to_safe_shape(unit, lost.applied[0], frames)
        else:
            assert move.wait(5) is Outcome.LINK_LOST
            wait_until(lambda: writer.state().link_up)
            assert writer.state().moving is None
            wait_until(lambda: len(unit.frames) > frames)
            assert signals_of(unit.frames[-1:]) == pytest.approx(lost.applied[0], abs=CODE)


@pytest.mark.slow
@pytest.mark.parametrize(("had_it_before", "locks"), [(True, False), (False, False), (False, True)])
def test_a_driver_that_waited_for_the_unit_begins_where_the_other_one_ended(
    unit: Edac40TcpUnit, tmp_path: Path, had_it_before: bool, locks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without locks, as between two machines, it is the unit that keeps the second one out."""
    if not locks:
        monkeypatch.setattr(LastShape, "claim", lambda self: None)
    path = tmp_path / "unit.shape"
    with ExitStack() as waiting:

        def start() -> ActuatorWriter:
            return waiting.enter_context(started_writer(unit, last=LastShape(path, 37)))[0]

        if had_it_before:
            second = start()
            assert second.wait_for_link(5) and second.enable(5)
            assert second.command(shape(0.2)).wait(5) is Outcome.REACHED
            unit.drop_client()
            wait_until(lambda: not second.state().link_up)
        with running_writer(unit, last=LastShape(path, 37)) as (first, _):
            if not had_it_before:
                second = start()
                assert not second.enable(0.0)
            assert first.command(shape(0.8)).wait(5) is Outcome.REACHED
            time.sleep(2.5)  # it tries once a second
            assert not second.state().link_up
            recorded = LastShape(path, 37).load()
            assert recorded is not None and SCALE.signals_of_codes(recorded) == pytest.approx(0.8)
        assert second.wait_for_link(5)
        wait_until(lambda: second.state().moving is None and second.state().applied is not None)
    seen = signals_of(unit.frames)
    assert np.abs(np.diff(seen, axis=0)).max() <= 0.1 + CODE
    assert seen[-1] == pytest.approx(-1.0, abs=CODE)


@pytest.mark.slow
def test_a_second_driver_of_a_unit_that_takes_frames_of_anybody_waits(tmp_path: Path) -> None:
    path = tmp_path / "unit.shape"
    with Edac40UdpUnit(discovery=False) as unit, ExitStack() as waiting:
        assert isinstance(unit, Edac40UdpUnit)
        with running_writer(unit, electronics=Edac40Udp, last=LastShape(path, 37)) as (first, _):
            assert first.command(shape(0.8)).wait(5) is Outcome.REACHED
            second, _ = waiting.enter_context(started_writer(unit, electronics=Edac40Udp, last=LastShape(path, 37)))
            assert not second.enable(0.5) and not second.state().link_up
            assert "another driver on this machine" in second.state().fault
            unit.unplug()  # nor does it get it when the first one has lost its link
            unit.plug()
            time.sleep(2.5)
            assert not second.state().link_up
        assert second.wait_for_link(5)
        wait_until(lambda: second.state().moving is None and second.state().applied is not None)
        wait_until(lambda: len(unit.frames) > 1 and signals_of(unit.frames[-1:])[0, 0] < -1.0 + 2 * CODE)
    assert np.abs(np.diff(signals_of(unit.frames), axis=0)).max() <= 0.1 + CODE


@pytest.mark.slow
def test_the_link_is_looked_at_in_a_move_and_between_commands_too(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=2.0, electronics=Counting) as (writer, _reports):
        electronics = writer._electronics
        assert isinstance(electronics, Counting)
        before, frames = electronics.checks, writer.counters.frames
        assert writer.command(shape(0.2)).wait(5) is Outcome.REACHED
        for number in range(8):
            time.sleep(0.1)
            writer.command(shape(0.2 + 0.01 * (number % 2)))
        # One look belongs to each frame.
        assert electronics.checks - before - (writer.counters.frames - frames) >= 4


@pytest.mark.slow
def test_disable_without_a_link_says_so(unit: Edac40TcpUnit) -> None:
    with running_writer(unit) as (writer, _reports):
        unit.unplug()
        wait_until(lambda: not writer.state().link_up)
        assert writer.disable(5) is Outcome.LINK_LOST


def test_stop_ends_a_move_that_somebody_waits_for(unit: Edac40TcpUnit) -> None:
    with running_writer(unit, slew_rate=1.0) as (writer, _reports):
        move = writer.command(shape(1.0))
        wait_until(lambda: len(unit.frames) > 1)
    assert move.wait(5) is Outcome.STOPPED


@pytest.mark.slow
def test_a_defect_in_a_back_end_does_not_end_the_thread(unit: Edac40TcpUnit) -> None:
    class Faulty(Edac40Tcp):
        calls = 0

        def _do_write(self, codes: np.ndarray, wired: np.ndarray) -> None:
            Faulty.calls += 1
            if Faulty.calls == 2:
                raise ZeroDivisionError("injected")
            super()._do_write(codes, wired)

    with running_writer(unit, electronics=Faulty) as (writer, reports):
        move = writer.command(shape(-0.9))
        assert move.wait(5) is Outcome.LINK_LOST
        wait_until(lambda: writer.state().link_up, what="reconnection")
        assert any("ZeroDivisionError: injected" in state.fault for state, _edge in reports)
        assert writer.command(shape(-0.9)).wait(5) is Outcome.REACHED
