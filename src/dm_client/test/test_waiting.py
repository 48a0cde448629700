"""What a client waits for, and what becomes of it when the client is closed. Without nodes."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
from dm_msgs.action import Converge, MoveFocus
from dm_msgs.msg import ActuatorState, Capabilities, RecipeBook
from dm_msgs.srv import SetSignals

from dm_client import DeformableMirrorClient, DeformableMirrorError, connection
from dm_common.errors import ErrorCode
from dm_common.ros import qos
from dm_common.ros.qos import Liveliness

#: A node that is there.
THERE: Any = SimpleNamespace(
    lost=False,
    heard=lambda: None,
    wait_for_return=lambda: None,
    since_now=lambda: lambda: "",
    missing=lambda _served: False,
)


def client(driver: int, able: int | None) -> DeformableMirrorClient:
    """One that has heard this state of the driver and this code of the controller; None = there is no controller."""
    heard = DeformableMirrorClient.__new__(DeformableMirrorClient)
    heard._background = SimpleNamespace(is_here=False)  # type: ignore[assignment]
    heard._context = SimpleNamespace(ok=lambda: True)
    heard._subscribed = {"actuator_state", "capabilities"}
    heard.messages = {"actuator_state": ActuatorState(driver_state=driver)}
    heard._servers, heard._timeout_s = {"set_signals": THERE}, 10.0
    if able is not None:
        heard.messages["capabilities"] = Capabilities(error_code=able, message="not yet")
    return heard


@pytest.mark.parametrize("able", [None, ErrorCode.OK, ErrorCode.NOT_CALIBRATED])
def test_it_is_ready_when_driver_and_controller_take_requests(able: int | None) -> None:
    client(ActuatorState.STATE_ACTIVE, able).wait_until_active(0.0)


@pytest.mark.parametrize(
    ("driver", "able", "code"),
    [
        (ActuatorState.STATE_INACTIVE, ErrorCode.OK, ErrorCode.DRIVER_INACTIVE),
        (ActuatorState.STATE_ACTIVE, ErrorCode.NODE_INACTIVE, ErrorCode.NODE_INACTIVE),
        # The driver is back, and the controller has not heard it yet.
        (ActuatorState.STATE_ACTIVE, ErrorCode.DRIVER_INACTIVE, ErrorCode.DRIVER_INACTIVE),
        (ActuatorState.STATE_ACTIVE, ErrorCode.DRIVER_UNAVAILABLE, ErrorCode.DRIVER_UNAVAILABLE),
        (ActuatorState.STATE_ACTIVE, ErrorCode.ELECTRONICS_UNREACHABLE, ErrorCode.ELECTRONICS_UNREACHABLE),
    ],
)
def test_it_is_not_ready_while_either_says_otherwise(driver: int, able: int, code: int) -> None:
    with pytest.raises(DeformableMirrorError) as waited:
        client(driver, able).wait_until_active(0.0)
    assert waited.value.error_code == code


def test_it_is_not_ready_while_the_driver_is_lost_whatever_that_said_before() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.NOT_CALIBRATED)
    mirror._servers = {"set_signals": SimpleNamespace(lost=True, text="pdm_driver has died")}  # type: ignore[dict-item]
    with pytest.raises(DeformableMirrorError, match="pdm_driver has died") as waited:
        mirror.wait_until_active(0.0)
    assert waited.value.error_code == ErrorCode.DRIVER_UNAVAILABLE


def test_without_a_report_the_driver_may_not_run() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, None)
    del mirror.messages["actuator_state"]
    with pytest.raises(DeformableMirrorError, match="no actuator_state from pdm_driver yet") as at:
        mirror.wait_until_active(0.0)
    assert at.value.error_code == ErrorCode.DRIVER_UNAVAILABLE


def test_what_was_heard_last_is_not_told_once_nothing_more_can_come() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    assert mirror.actuator_state.driver_state == ActuatorState.STATE_ACTIVE
    mirror._context = SimpleNamespace(ok=lambda: False)  # type: ignore[assignment]
    with pytest.raises(DeformableMirrorError, match="rclpy was shut down"):
        _ = mirror.actuator_state


def test_who_gives_feedback_lives(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the lease of a node that goes on with a run may lapse for its client."""
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    heard, feedback = list[int](), list[str]()
    server: Any = SimpleNamespace(**vars(THERE) | {"heard": lambda: heard.append(len(feedback))})
    mirror._servers, mirror.clients, mirror._timeout_s = {"converge": server}, {"converge": None}, 1.0

    def run_goal(*_arguments: object, on_feedback: object, **_options: object) -> Converge.Result:
        on_feedback("step 1")  # type: ignore[operator]
        return Converge.Result()

    monkeypatch.setattr(connection, "run_goal", run_goal)
    mirror.run_action("converge", Converge.Goal(), feedback.append, 1.0)
    assert (heard, feedback) == ([0], ["step 1"])


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_an_error_in_feedback_cancels_the_goal_and_is_raised(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """rclpy's executor ends the whole process with it."""
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    mirror._servers, mirror.clients, mirror._timeout_s = {"converge": THERE}, {"converge": None}, 1.0
    cancelled = list[bool]()

    def run_goal(*_arguments: object, on_feedback: Any, stop: Any, **_options: object) -> Converge.Result:
        cancelled.append(stop())
        on_feedback("step 1")
        on_feedback("step 2")
        cancelled.append(stop())
        return Converge.Result(error_code=ErrorCode.CANCELED)

    def fail(feedback: object) -> None:
        raise error(feedback)

    monkeypatch.setattr(connection, "run_goal", run_goal)
    with pytest.raises(error, match="step 1"):
        mirror.run_action("converge", Converge.Goal(), fail, 1.0)
    assert cancelled == [False, True]


def test_a_topic_that_it_does_not_hear_is_named() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    with pytest.raises(DeformableMirrorError, match="'zernike': must be one of actuator_state") as refused:
        mirror.latest("zernike")
    assert refused.value.error_code == ErrorCode.UNKNOWN_NAME


def test_a_topic_that_is_heard_has_a_latest_message(domain: int) -> None:
    with DeformableMirrorClient(domain=domain) as mirror:
        mirror.subscribe("recipes", RecipeBook, qos.LATCHED)
        publisher = mirror.node.create_publisher(RecipeBook, "recipes", qos.LATCHED)
        publisher.publish(RecipeBook(calibration_id="c1"))
        assert mirror.latest("recipes", 20.0).calibration_id == "c1"


def test_services_and_actions_are_not_taken_for_each_other(domain: int) -> None:
    with DeformableMirrorClient(domain=domain) as mirror:
        with pytest.raises(DeformableMirrorError, match=r"'move_focus': must be one of .*set_focus") as called:
            mirror.call("move_focus", None)
        with pytest.raises(DeformableMirrorError, match=r"'set_focus': must be one of .*move_focus") as run:
            mirror.run_action("set_focus", None, print, 1.0)
        assert called.value.error_code == run.value.error_code == ErrorCode.UNKNOWN_NAME


def test_who_waits_in_another_thread_hears_that_the_client_was_closed(domain: int) -> None:
    waits = [
        lambda mirror: mirror.focus(0.01),
        lambda mirror: mirror.move_focus(0.01),
        lambda mirror: mirror.latest("calibration", 60.0),
    ]
    with DeformableMirrorClient(domain=domain, timeout_s=60.0) as mirror:
        texts = list[str]()

        def ask(way: Any) -> None:
            with pytest.raises(DeformableMirrorError) as ended:
                way(mirror)
            texts.append(str(ended.value))

        threads = [threading.Thread(target=ask, args=(way,)) for way in waits]
        for thread in threads:
            thread.start()
        time.sleep(0.3)
    for thread in threads:
        thread.join(5.0)
    for way in waits:  # and who asks only now
        ask(way)
    assert len(texts) == 6 and all(text.endswith("the client has been closed") for text in texts)
    with pytest.raises(DeformableMirrorError, match="the client has been closed"):
        mirror.subscribe("another", ActuatorState, 1)


def test_who_waits_hears_that_rclpy_was_shut_down(domain: int) -> None:
    """As handlers of `rclpy.init()` do at a signal: they end every context of the process."""
    with DeformableMirrorClient(domain=domain, timeout_s=60.0) as mirror, ThreadPoolExecutor(2) as pool:
        waits = pool.submit(mirror.move_focus, 0.01), pool.submit(mirror.latest, "calibration", 60.0)
        time.sleep(0.3)
        mirror.node.context.try_shutdown()
        for waiting in waits:
            with pytest.raises(DeformableMirrorError, match="rclpy was shut down"):
                waiting.result(10.0)


def test_a_name_that_is_not_served_is_refused(domain: int) -> None:
    with DeformableMirrorClient(domain=domain) as mirror:
        cases = [
            (lambda: mirror.call("nonsense", None), "hold_mirror, measure"),
            (lambda: mirror.run_action("nonsense", None, print, 1.0), "degauss, calibrate, move_focus"),
        ]
        for ask, names in cases:
            with pytest.raises(DeformableMirrorError, match=f"'nonsense': must be one of .*{names}") as refused:
                ask()
            assert refused.value.error_code == ErrorCode.UNKNOWN_NAME


def test_a_service_that_is_not_there_is_not_waited_for_as_long_as_its_answer() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    absent = SimpleNamespace(service_is_ready=lambda: False, srv_name="/measure")
    mirror._servers, mirror.clients, mirror._timeout_s = {"measure": THERE}, {"measure": absent}, 0.1
    with pytest.raises(DeformableMirrorError, match=r"no such service within 0\.1 s"):
        mirror.measure()


def test_a_node_that_never_came_is_named() -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    absent = SimpleNamespace(service_is_ready=lambda: False, srv_name="/measure")
    never = Liveliness.__new__(Liveliness)
    never.name, never.lost, never.starts, never._born = "interferometer", False, 0, -math.inf
    mirror._servers, mirror.clients, mirror._timeout_s = {"measure": never}, {"measure": absent}, 0.1
    with pytest.raises(
        DeformableMirrorError, match="measure: the node interferometer is not running: start it"
    ) as refused:
        mirror.measure()
    assert refused.value.error_code == ErrorCode.INTERFEROMETER_UNAVAILABLE


def test_a_way_is_waited_for_however_slow_the_limits_are(monkeypatch: pytest.MonkeyPatch) -> None:
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    names = ("set_signals", "move_focus")
    mirror._servers, mirror.clients, mirror._timeout_s = dict.fromkeys(names, THERE), dict.fromkeys(names), 10.0
    limits = list[tuple[float, ...]]()  # of waiting, and after which a request to a service is sent again

    def answer(_client: object, request: Any, timeout_s: float, *more: Any, **_options: object) -> Any:
        limits.append((timeout_s, *more[1:]))
        kind = SetSignals.Response if isinstance(request, SetSignals.Request) else MoveFocus.Result
        return kind()

    monkeypatch.setattr(connection, "call", answer)
    monkeypatch.setattr(connection, "run_goal", answer)
    mirror.set_signals([0.0] * 37)
    mirror.move_focus(0.01)
    mirror.set_signals([0.0] * 37, wait=False)
    assert limits == [(math.inf, 10.0), (math.inf,), (10.0, 10.0)]


def test_what_asks_inside_a_callback_is_refused_at_once() -> None:
    """Nobody would take the answer."""
    mirror = client(ActuatorState.STATE_ACTIVE, ErrorCode.OK)
    mirror._background = SimpleNamespace(is_here=True)  # type: ignore[assignment]
    with pytest.raises(DeformableMirrorError, match=r"flatten: .* call it from another thread"):
        mirror.flatten()


def test_a_program_that_closes_nothing_ends_in_order(domain: int) -> None:
    """Though something comes at that moment; it would end with SIGABRT."""
    program = f"""from dm_client import DeformableMirrorClient
mirror = DeformableMirrorClient(domain={domain})
mirror.node.create_timer(1e-3, int)"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
