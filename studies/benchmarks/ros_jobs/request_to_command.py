"""Curvature request to actuator command, between processes: the focus controller beside a bare relay.

Every request waits for its answer before the next one. The nodes take turns, so that a busy moment of the machine
affects relay and controller alike; figures are medians over blocks of such turns. The controller runs as on a bench: a
calibration with identified hysteresis, and a driver that reports every move.
"""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorCommand, ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo

from dm_bringup.nodes import MODULES
from dm_common import Floats
from dm_common.messages import doubles
from dm_common.ros import qos
from studies.benchmarks import stand_in_mirror
from studies.benchmarks.ros_jobs.ros_processes import ProcessHarness, process_harness
from studies.benchmarks.timing import Effort

#: Class of the hysteresis model in the calibration.
LAW = "Preisach"
#: Largest curvature requested, 1/m: reachable, some actuators at their limits.
REACH = 0.03
#: Pauses between two requests, s: one that lets the node finish its work after a command, and one with which each of
#: two peers gets some 100 requests a second.
PAUSE_S, CAMERA_PAUSE_S = 1e-3, 4e-3
#: Number of requests for each peer in one block; figures are medians over blocks.
BLOCK = 150
WARM_UP = 50
#: Rate of a stream that must not make queues grow, 1/s.
STREAM_RATE = 500.0
ANSWER_S = 2.0
#: Period of the driver's reports when nothing happens, s: a silent driver is taken for dead.
REPORT_PERIOD_S = 0.5
EXECUTORS = ("events", "single", "multi")


@dataclass
class Peer:
    """One node under test: its publishers, and the arrival times of its answers.

    Attributes:
        answers: commands in order, each with its time of arrival, ns.
    """

    harness: ProcessHarness
    namespace: str
    answers: list[tuple[int, ActuatorCommand]] = field(default_factory=list)

    def __post_init__(self) -> None:
        node = self.harness.node
        self.publisher = node.create_publisher(FocusRequest, f"/{self.namespace}/focus_request", qos.COMMAND)
        topic = f"/{self.namespace}/actuator_command"
        self.subscription = node.create_subscription(ActuatorCommand, topic, self._on_command, qos.STATE)

    def _on_command(self, command: ActuatorCommand) -> None:
        self.answers.append((time.perf_counter_ns(), command))
        self.after(command)

    def answered_curvatures(self) -> list[tuple[int, float]]:
        """Times of the answers (ns) with the curvatures of their requests."""
        return [(when, command.signals[0]) for when, command in self.answers]

    def after(self, command: ActuatorCommand) -> None:
        """Simulate the neighbours' reaction to a command."""

    def connected(self) -> bool:
        """Whether the node is connected in both directions."""
        return bool(
            self.publisher.get_subscription_count() and self.harness.node.count_publishers(self.subscription.topic)
        )

    def request(self, curvature: float) -> int:
        """Send a request; returns the time, ns."""
        message = FocusRequest(curvature=curvature)
        message.header.stamp = self.harness.node.get_clock().now().to_msg()
        sent = time.perf_counter_ns()
        self.publisher.publish(message)
        return sent

    def round_trip(self, curvature: float) -> float:
        """Time until the command, s; NaN when there was none."""
        self.answers.clear()
        sent = self.request(curvature)
        self.harness.serve(ANSWER_S, lambda: bool(self.answers))
        return 1e-9 * (self.answers[0][0] - sent) if self.answers else float("nan")


class FocusPeer(Peer):
    """The focus controller among stand-ins of its neighbours: a calibration, and a driver that moves at once."""

    def __post_init__(self) -> None:
        super().__post_init__()
        node, prefix = self.harness.node, f"/{self.namespace}"
        self._info = node.create_publisher(MirrorInfo, f"{prefix}/mirror_info", qos.LATCHED)
        self._calibration = node.create_publisher(Calibration, f"{prefix}/calibration", qos.LATCHED)
        self._state = node.create_publisher(ActuatorState, f"{prefix}/actuator_state", qos.STATE)
        self._capabilities: list[Capabilities] = []
        node.create_subscription(Capabilities, f"{prefix}/capabilities", self._capabilities.append, qos.LATCHED)
        self.focus_states: list[FocusState] = []
        node.create_subscription(FocusState, f"{prefix}/focus_state", self.focus_states.append, qos.STATE)
        self._turns = 0
        self._degausses = 0
        self._reported: ActuatorState | None = None
        node.create_timer(REPORT_PERIOD_S, lambda: self._reported and self._state.publish(self._reported))

    def answered_curvatures(self) -> list[tuple[int, float]]:
        curvature_at = {_ns(state.header.stamp): state.curvature for state in self.focus_states if state.applied}
        stamped = [(when, _ns(command.header.stamp)) for when, command in self.answers]
        return [(when, curvature_at[stamp]) for when, stamp in stamped if stamp in curvature_at]

    def after(self, command: ActuatorCommand) -> None:
        self._turns += 1
        self._report(command.signals)

    def _report(self, signals: Any) -> None:
        report = ActuatorState(
            driver_state=ActuatorState.STATE_ACTIVE,
            requested=signals,
            applied=signals,
            turns=self._turns,
            turned_at=signals,
            degausses=self._degausses,
            history_known=self._degausses > 0,
        )
        report.header.stamp = self.harness.node.get_clock().now().to_msg()
        self._reported = report
        self._state.publish(report)

    def calibrate(self) -> None:
        """Have the controller take the calibration, and report a degauss, so that it knows the history."""
        self._info.publish(stand_in_mirror.mirror_info())
        self._calibration.publish(stand_in_mirror.calibration(LAW))
        self._report(doubles(np.zeros(37)))  # nothing is reachable without a driver that reports
        self.harness.wait_for(
            "the controller's calibration",
            lambda: self._capabilities and self._capabilities[-1].quality == Capabilities.CALIBRATED,
        )
        self._degausses = 1
        self._report(doubles(np.zeros(37)))
        self.harness.serve(0.5)


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figures `relay`, `focus`, `executors` and `stream`; times in us.

    Raises:
        RuntimeError: a node ended, or did not answer.
    """
    generator = np.random.default_rng(500)
    blocks = 2 if effort.quick else 16
    with process_harness() as harness:
        relay, focus = _started(harness, "events"), _controller(harness)
        _collected([relay, focus], WARM_UP, generator)
        turns = [_collected([relay, focus], BLOCK, generator) for _ in range(blocks)]
        camera = [_collected([relay, focus], BLOCK, generator, CAMERA_PAUSE_S) for _ in range(max(blocks // 4, 2))]
        stream = {
            name: _stream(harness, peer, 2.0 if effort.quick else 10.0, generator)
            for name, peer in (("relay", relay), ("focus", focus))
        }
    with process_harness() as harness:
        peers = [_started(harness, kind) for kind in EXECUTORS]
        _collected(peers, WARM_UP, generator)
        # The multi-threaded executor of Jazzy slows down whatever runs beside it, so it comes only here.
        executors = [_collected(peers, BLOCK, generator, CAMERA_PAUSE_S) for _ in range(1 if effort.quick else 4)]
    return {
        "relay": _percentiles(turns, 0),
        "focus": _percentiles(turns, 1) | _ratios(turns) | {"law": LAW},
        "at_100_hz": {"relay": _percentiles(camera, 0), "focus": _percentiles(camera, 1) | _ratios(camera)},
        "executors": {kind: _percentiles(executors, row) for row, kind in enumerate(EXECUTORS)},
        "stream": stream,
    }


def _started(harness: ProcessHarness, executor: str) -> Peer:
    namespace = f"relay_{executor}"
    harness.start("studies.benchmarks.ros_jobs.relay_node", executor, namespace=namespace)
    peer = Peer(harness, namespace)
    harness.wait_for(f"the relay with the executor {executor}", peer.connected)
    harness.serve(0.5)
    return peer


def _controller(harness: ProcessHarness) -> FocusPeer:
    harness.start(MODULES["focus_controller"], namespace="focus")
    peer = FocusPeer(harness, "focus")
    harness.wait_for("the focus controller", peer.connected)
    harness.serve(0.5)
    peer.calibrate()
    return peer


def _collected(peers: list[Peer], rounds: int, generator: np.random.Generator, pause_s: float = PAUSE_S) -> Floats:
    """(peers, rounds) round trips in turns, us; NaN = no answer."""
    seconds = np.empty((len(peers), rounds))
    gc.collect()
    gc.disable()
    try:
        for turn in range(rounds):
            for row in generator.permutation(len(peers)):
                seconds[row, turn] = peers[row].round_trip(float(generator.uniform(-REACH, REACH)))
                peers[row].harness.serve(pause_s)
    finally:
        gc.enable()
    return 1e6 * seconds


def _percentiles(turns: list[Floats], peer: int) -> dict[str, float]:
    """Figures of one peer, from blocks (peers, n): medians over the blocks."""
    microseconds = np.array(turns)[:, peer]
    p50, p99 = np.median(np.nanpercentile(microseconds, (50, 99), axis=1), axis=1)
    return {"p50_us": float(p50), "p99_us": float(p99), "lost": int(np.count_nonzero(np.isnan(microseconds)))}


def _ratios(turns: list[Floats]) -> dict[str, float]:
    """Ratios of controller to relay within each of the blocks (2, n): median and smallest over the blocks."""
    levels = np.nanpercentile(np.array(turns), (50, 99), axis=2)  # (2, B, 2)
    ratio = levels[:, :, 1] / levels[:, :, 0]
    return {
        "ratio_p50": float(np.median(ratio[0])),
        "ratio_p99": float(np.median(ratio[1])),
        "least_ratio_p50": float(ratio[0].min()),
        "least_ratio_p99": float(ratio[1].min()),
    }


def _stream(harness: ProcessHarness, peer: Peer, seconds: float, generator: np.random.Generator) -> dict[str, float]:
    """Send requests at STREAM_RATE without waiting: how many are answered, and whether answers become later."""
    peer.answers.clear()
    sent: dict[float, int] = {}
    began = time.monotonic()
    for number, curvature in enumerate(generator.uniform(-REACH, REACH, round(seconds * STREAM_RATE))):
        harness.serve(began + number / STREAM_RATE - time.monotonic())
        sent[float(curvature)] = peer.request(float(curvature))
    lasted = time.monotonic() - began
    harness.serve(1.0)
    age = 1e-3 * np.array([when - sent[curvature] for when, curvature in peer.answered_curvatures()])
    quarter = max(len(age) // 4, 1)
    return {
        "rate": len(sent) / lasted,
        "answered_share": len(peer.answers) / len(sent),
        "p50_us": float(np.median(age)),
        "p99_us": float(np.percentile(age, 99)),
        "first_quarter_p50_us": float(np.median(age[:quarter])),
        "last_quarter_p50_us": float(np.median(age[-quarter:])),
    }
