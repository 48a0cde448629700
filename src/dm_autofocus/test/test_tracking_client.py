"""What the client makes of time: how long it stays on the focus, which images count. Without processes."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import AutofocusState, FocusState
from sensor_msgs.msg import Image

from dm_autofocus import CameraFocusClient, camera_client
from dm_client import DeformableMirrorError
from dm_common.errors import ErrorCode
from dm_common.messages import time_message


@pytest.mark.parametrize("lost_after", [None, 3.0])
def test_it_tracks_from_the_end_of_the_search_on(lost_after: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    client, now = CameraFocusClient.__new__(CameraFocusClient), [100.0]
    monkeypatch.setattr(camera_client, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def run_action(
        _name: str, goal: Any, on_feedback: Callable[[Any], None], _limit: float, enough: Callable[[], bool]
    ) -> None:
        assert goal.track
        now[0] += 20.0
        on_feedback(SimpleNamespace(phase=AutofocusState.PHASE_COARSE))
        assert not enough(), "a search takes as long as it takes"
        begun = now[0]
        while not enough():
            on_feedback(SimpleNamespace(phase=AutofocusState.PHASE_TRACK))
            now[0] += 0.5
            if lost_after is not None and now[0] - begun > lost_after:
                raise DeformableMirrorError(ErrorCode.DRIVER_INACTIVE, "no more")
        assert now[0] - begun == 5.5
        raise DeformableMirrorError(ErrorCode.TIMEOUT, "not finished")

    monkeypatch.setattr(client, "run_action", run_action)
    heard: list[Any] = []
    if lost_after is None:
        client.track(5.0, on_feedback=heard.append)
        assert len(heard) == 12
    else:
        with pytest.raises(DeformableMirrorError, match="no more"):
            client.track(5.0, on_feedback=heard.append)


@pytest.mark.parametrize(
    ("ask", "text"),
    [
        (lambda camera: camera.autofocus(curvature_range=(0.01,)), "curvature_range = .0.01,.: must be two curvatures"),
        (lambda camera: camera.focus_stack(curvature_range=None), "curvature_range = None: must be two curvatures"),
        (lambda camera: camera.autofocus(curvature_range=("low", 0.02)), "curvature_min = 'low': must be double"),
        (lambda camera: camera.track(math.nan), "seconds = nan: must be a number, 0 or more"),
        (lambda camera: camera.boresight((0.5, 0.5, 1.0, 1.0)), "region = .*: left, top, width, height"),
        (lambda camera: camera.boresight(None), "NoneType"),
        (lambda camera: camera.boresight((0.5, 0.5, 0.5, 0.5), pairs=1), "pairs = 1: must be 2 or more"),
        (lambda camera: camera.focus_power("much"), "power = 'much': must be double"),
    ],
)
def test_an_argument_that_cannot_be_is_refused_by_name(ask: Callable[[Any], object], text: str) -> None:
    with pytest.raises(DeformableMirrorError, match=text):
        ask(CameraFocusClient.__new__(CameraFocusClient))


@pytest.mark.parametrize(("stamp", "counts"), [(10.3, False), (10.4, True)])
def test_the_axis_is_found_by_images_exposed_after_the_move(
    stamp: float, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A move of 0.1 s from 10 s on, 0.05 s to settle, and stamps that come 0.2 s after the exposure began."""
    client = CameraFocusClient.__new__(CameraFocusClient)
    image, state = (
        Image(height=8, width=8, step=8, encoding="mono8", data=bytes(64)),
        FocusState(predicted_duration=0.1),
    )
    image.header.stamp, state.header.stamp = time_message(round(stamp * 1e9)), time_message(10 * 10**9)
    reach = SimpleNamespace(curvature_min=-0.05, curvature_max=0.05, curvature_tolerance=1e-4)
    played = {
        "autofocus": lambda *_region: SimpleNamespace(curvature=0.0),
        "focus_range": lambda: reach,
        "subscribe": lambda *_topic: True,
        "focus": lambda *_curvature, **_shape: state,
        "wait": lambda condition: condition(),
        "messages": {"image_raw": image},
    }
    for name, value in played.items():
        monkeypatch.setattr(client, name, value, raising=False)
    monkeypatch.setattr(camera_client, "find_boresight", lambda see, *_plan: see(0.0, np.zeros(2)).size)
    if counts:
        assert client.boresight([0, 0, 1, 1], stamp_lead=0.2) == 64
    else:
        with pytest.raises(DeformableMirrorError, match="no image on image_raw"):
            client.boresight([0, 0, 1, 1], stamp_lead=0.2)
