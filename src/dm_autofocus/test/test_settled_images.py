"""Which images count, in simulated time: every row of them shows the focus that was asked for."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from dm_autofocus.images import STAMP_AHEAD_SIMULATED, SettledGate

SETTLE, MOVE = 0.004, 0.03


@dataclass(frozen=True)
class Camera:
    """Times in s; `lost` and `late`: every so manieth image is, 0 = none."""

    period: float = 1 / 30
    exposure: float = 0.008
    read_out: float = 0.0
    stamp_lead: float = 0.0
    lost: int = 0
    late: int = 0


CAMERAS = {
    "global shutter": Camera(),
    "rolling shutter": Camera(read_out=0.03),
    "rolling shutter, stamped at its end": Camera(read_out=0.03, stamp_lead=0.038),
    "every third image is lost": Camera(read_out=0.02, lost=3),
    "every second image comes 50 ms late": Camera(read_out=0.02, late=2),
    "slower than told": Camera(period=0.7),
    "faster than the mirror": Camera(period=0.004, exposure=0.003),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_every_row_of_an_image_that_counts_shows_the_focus_that_was_asked_for(camera: Camera) -> None:
    """A new focus is asked for when an image that counts has arrived; the mirror then moves for 30 ms."""
    gate = SettledGate(SETTLE, camera.stamp_lead)
    commands = [0.0]  # when each was sent
    gate.sent(0.0, MOVE)
    arrivals = []
    for number in range(200):
        begin = number * camera.period
        end = begin + camera.read_out + camera.exposure
        if camera.lost and number % camera.lost == 0:
            continue
        delay = 0.05 if camera.late and number % camera.late == 0 else 0.002
        arrivals.append((end + delay, begin, end))
    counted = 0
    for arrived, begin, end in sorted(arrivals):
        arrival = commands[-1] + MOVE
        if arrived >= arrival:
            gate.written(arrival, moving=False, reached=True)
        if not gate.open_for(begin + camera.stamp_lead):
            continue
        counted += 1
        assert begin >= arrival + SETTLE, "the first row"
        assert end <= arrived, "the last row was read before the next move began"
        commands.append(arrived)
        gate = SettledGate(SETTLE, camera.stamp_lead)
        gate.sent(arrived, MOVE)
    assert counted >= 5


def test_images_without_a_stamp_never_count() -> None:
    gate = SettledGate(SETTLE)
    gate.sent(100.0, MOVE)
    gate.written(100.0 + MOVE, moving=False, reached=True)
    assert not gate.open_for(0.0)


def test_images_stamped_ahead_of_the_time_never_count() -> None:
    """They would count though they were exposed before the move; a simulated clock may lag a little."""
    gate, simulated = SettledGate(SETTLE), SettledGate(SETTLE, ahead=STAMP_AHEAD_SIMULATED)
    corrected = SettledGate(SETTLE, stamp_lead=0.2)
    for one in (gate, simulated, corrected):
        one.sent(100.0, MOVE)
        one.written(100.0 + MOVE, moving=False, reached=True)
    assert simulated.open_for(100.4, now=100.2) and not gate.open_for(100.4, now=100.2)
    assert corrected.open_for(100.4, now=100.2), "stamp_lead tells by how much that clock is ahead"
    assert gate.open_for(100.21, now=100.2)
    assert "exposed 0.200 s ahead of this node's clock" in gate.reason(100.4, 0.03, 2.0, now=100.2)
    assert "exposed 2.800 s ahead of this node's clock" in simulated.reason(103.0, 3.0, 2.0, now=100.2)


def test_a_camera_that_stopped_is_not_told_to_set_its_clock() -> None:
    gate = SettledGate(SETTLE)
    gate.sent(100.0, MOVE)
    assert gate.reason(None, 0.03, 2.0) == "none came; is the camera running?"
    assert "takes one image in 3 s" in gate.reason(None, 3.0, 2.0), "or is it that slow?"


def test_a_stamp_at_the_end_of_a_long_exposure_is_told_as_the_reason() -> None:
    gate = SettledGate(0.0, stamp_lead=3.0)
    gate.sent(100.0)
    gate.written(100.0, moving=False, reached=True)
    assert "the newest was exposed 1.100 s before the shape was reached" in gate.reason(101.9, 0.03, 2.0)
