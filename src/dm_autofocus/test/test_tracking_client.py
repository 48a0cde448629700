"""How long the client stays on the focus. Without processes, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from dm_msgs.msg import AutofocusState

from dm_autofocus import CameraFocusClient, camera_client
from dm_client import DeformableMirrorError
from dm_common.errors import ErrorCode


@pytest.mark.parametrize("lost_after", [None, 3.0])
def test_it_tracks_from_the_end_of_the_search_on(lost_after: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    client, now = CameraFocusClient.__new__(CameraFocusClient), [100.0]
    monkeypatch.setattr(camera_client, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def run_action(
        _name: str, goal: Any, hear: Callable[[Any], None], _limit: float, enough: Callable[[], bool]
    ) -> None:
        assert goal.track
        now[0] += 20.0
        hear(SimpleNamespace(phase=AutofocusState.PHASE_COARSE))
        assert not enough(), "a search takes as long as it takes"
        begun = now[0]
        while not enough():
            hear(SimpleNamespace(phase=AutofocusState.PHASE_TRACK))
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
