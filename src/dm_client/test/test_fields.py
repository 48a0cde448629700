"""What Python programs give a client, and what becomes of it in a message."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dm_msgs.action import BuildRecipes, Degauss
from dm_msgs.msg import FocusRequest, MirrorInfo
from dm_msgs.srv import IngestFile, Measure, SetFocus, SetSignals, UpdateCalibration

from dm_client import DeformableMirrorClient, DeformableMirrorError
from dm_client.fields import filled
from dm_common.errors import ErrorCode


def test_what_means_the_same_is_taken() -> None:
    """rclpy would end the process at each of them."""
    assert filled(Degauss.Goal, steps=np.int64(12), take_over=np.bool_(True)) == Degauss.Goal(steps=12, take_over=True)
    assert filled(IngestFile.Request, path=Path("/a.dat")).path == "/a.dat"
    assert filled(SetFocus.Request, dry_run=1).dry_run is True
    signals = filled(SetSignals.Request, signals=np.array([0.5, -1], dtype=np.float32), wait=0).signals
    assert list(signals) == [0.5, -1.0]
    assert list(filled(UpdateCalibration.Request, without=np.array([3, 5])).without) == [3, 5]
    assert filled(BuildRecipes.Goal, curvatures=(1, np.float32(0.5))) == BuildRecipes.Goal(curvatures=[1.0, 0.5])


@pytest.mark.parametrize(
    ("kind", "fields", "code", "text"),
    [
        (Degauss.Goal, {"steps": -1}, ErrorCode.OUT_OF_RANGE, r"steps = -1: must be 0 to \d+"),
        (Degauss.Goal, {"steps": 1.5}, ErrorCode.INVALID_ARGUMENT, r"steps = 1.5: must be uint32"),
        (Measure.Request, {"label": 3}, ErrorCode.INVALID_ARGUMENT, "label = 3: must be string"),
        (IngestFile.Request, {"path": b"/a"}, ErrorCode.INVALID_ARGUMENT, "path = b'/a': must be string"),
        (IngestFile.Request, {"path": "/\udcfc"}, ErrorCode.INVALID_ARGUMENT, "path = .* must be string of UTF-8"),
        (SetSignals.Request, {"holder": "a\0b"}, ErrorCode.INVALID_ARGUMENT, r"holder = 'a.x00b': must be .* no NUL"),
        (UpdateCalibration.Request, {"without": [-1]}, ErrorCode.OUT_OF_RANGE, "without = -1: must be 0 to"),
        (UpdateCalibration.Request, {"without": 5}, ErrorCode.INVALID_ARGUMENT, "without = 5: must be sequence"),
        (SetSignals.Request, {"signals": ["a"]}, ErrorCode.INVALID_ARGUMENT, "signals = .'a'.: must be sequence"),
        (SetSignals.Request, {"signals": [10**400]}, ErrorCode.INVALID_ARGUMENT, "signals = .10+.: must be sequence"),
        (SetSignals.Request, {"signals": "123"}, ErrorCode.INVALID_ARGUMENT, "signals = '123': must be sequence"),
        (SetSignals.Request, {"take_over": "no"}, ErrorCode.INVALID_ARGUMENT, "take_over = 'no': must be true or"),
        (SetSignals.Request, {"wait": 2}, ErrorCode.INVALID_ARGUMENT, "wait = 2: must be true or false"),
        (SetSignals.Request, {"holdr": "me"}, ErrorCode.INVALID_ARGUMENT, "field 'holdr' is unknown; did you mean"),
        (SetSignals.Request, {"z": 1, "holdr": ""}, ErrorCode.INVALID_ARGUMENT, "field 'holdr'.*field 'z' is unknown"),
    ],
)
def test_what_is_no_such_thing_is_refused_by_name(kind: Any, fields: dict[str, Any], code: int, text: str) -> None:
    with pytest.raises(DeformableMirrorError, match=text) as refused:
        filled(kind, **fields)
    assert refused.value.error_code == code


def test_the_interferometer_keeps_the_time_of_a_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(DeformableMirrorClient, "call", lambda _self, *arguments: calls.append(arguments))
    DeformableMirrorClient.__new__(DeformableMirrorClient).measure("night", timeout_s=7)
    ((name, request, waits),) = calls
    assert (name, request.timeout) == ("measure", 7.0) and waits > 7.0, "its answer says why"


def test_a_shape_may_be_asked_for_by_the_recipes(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    for way in ("call", "run_action"):
        monkeypatch.setattr(DeformableMirrorClient, way, lambda _self, *arguments: sent.append(arguments[1].request))
    mirror = DeformableMirrorClient.__new__(DeformableMirrorClient)
    mirror.move_focus(0.02, mode=FocusRequest.MODE_CONDITIONED, holder="me")
    with pytest.raises(AttributeError):  # nothing answers
        mirror.focus(0.02, time_budget=np.float32(4.0))
    assert (sent[0].mode, sent[0].holder, sent[1].mode, sent[1].time_budget) == ("conditioned", "me", "", 4.0)


def test_what_takes_as_long_as_the_instrument_takes_is_not_given_up_before_its_node_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of 213 maps at 40 s each, which are two hours and more, or of one for which somebody presses a button."""
    waits: dict[str, float] = {}

    def record(_self: Any, name: str, request: Any, *rest: Any) -> None:
        assert name != "measure" or request.timeout == 0.0, "as configured"
        waits[name] = rest[-1]

    for way in ("call", "run_action"):
        monkeypatch.setattr(DeformableMirrorClient, way, record)
    mirror = DeformableMirrorClient.__new__(DeformableMirrorClient)
    mirror.measure()
    mirror.update_calibration()
    mirror.calibrate()
    mirror.converge(0.0)
    mirror.build_recipes([0.0])
    mirror.degauss()
    assert len(waits) == 6 and set(waits.values()) == {math.inf}


@pytest.mark.parametrize("domain", [233, -1, "1"])
def test_a_domain_that_cannot_be_is_refused(domain: Any) -> None:
    """Fast DDS ends the whole process."""
    with pytest.raises(DeformableMirrorError, match=f"domain = {domain!r}: must be 0 to 232") as refused:
        DeformableMirrorClient(domain=domain)
    assert refused.value.error_code == ErrorCode.OUT_OF_RANGE


@pytest.mark.parametrize("namespace", ["1bad", "my mirror", "a//b", "a__b"])
def test_a_namespace_that_cannot_be_is_refused(namespace: str) -> None:
    with pytest.raises(DeformableMirrorError, match="namespace = ") as refused:
        DeformableMirrorClient(namespace)
    assert refused.value.error_code == ErrorCode.INVALID_ARGUMENT


@pytest.mark.parametrize(("namespace", "place"), [("left", "/left"), ("/left/", "/left"), ("", "/")])
def test_a_client_in_a_launched_process_talks_to_the_mirror_that_it_is_for(
    namespace: str, place: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What launch calls the user's own node, and where that is, is not the client's."""
    argv = ["vision", "--ros-args", "-r", "__ns:=/right", "-r", "__node:=my_vision", "-r", "image_raw:=/camera/image"]
    monkeypatch.setattr("sys.argv", argv)
    with DeformableMirrorClient(namespace, domain) as client:
        assert client.node.get_namespace() == place
        assert client.node.get_name().startswith("dm_client_")
        assert client.node.resolve_service_name("set_focus") == f"{place.rstrip('/')}/set_focus"
        assert client.node.resolve_topic_name("image_raw") == "/camera/image"


def test_a_topic_that_cannot_be_is_refused(domain: int) -> None:
    with DeformableMirrorClient(domain=domain) as client:
        for _again in range(2):
            with pytest.raises(DeformableMirrorError, match="topic = 'a b': Invalid topic name") as refused:
                client.subscribe("a b", MirrorInfo, 10)
            assert refused.value.error_code == ErrorCode.INVALID_ARGUMENT
