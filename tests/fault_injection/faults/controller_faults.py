"""Faults around the focus controller: its calibration, its driver, its clients."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from builtin_interfaces.msg import Time
from dm_msgs.action import Converge, MoveFocus
from dm_msgs.msg import ActuatorState, Capabilities, ErrorCode, FocusRequest
from lifecycle_msgs.msg import Transition

from fault_injection.fault import Fault, FaultRecord
from fault_injection.rigs.common_steps import checked
from fault_injection.rigs.driver_rig import RigError
from fault_injection.rigs.focus_rig import ANSWER_S, DRIVER_TIMEOUT_S, FocusRig

#: Injections per start of the nodes.
ROUNDS = 3
#: Clients at once, in so many processes, and the requests of each.
CLIENTS, CLIENT_PROCESSES, REQUESTS = 100, 4, 8
#: Longest time that the clients may take in all, s.
CLIENTS_S = 240.0

Injection = Callable[[FocusRig, Random, FaultRecord], None]
REGISTRY: dict[str, Fault] = {}


def fault(words: str, rounds: int = ROUNDS, **parameters: Any) -> Callable[[Injection], Injection]:
    """Register an injection, into a rig that has a calibration and follows requests, under its function's name."""

    def register(inject: Injection) -> Injection:
        def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
            with FocusRig(folder, domain, **parameters) as rig, checked(rig, record):
                rig.refocus(random)
                for _ in range(rounds):
                    inject(rig, random, record)
                    record.injected += 1
                    record.recovery_s.append(rig.refocus(random))

        REGISTRY[inject.__name__] = Fault(inject.__name__, words, run)
        return inject

    return register


def lost(record: FaultRecord, words: str) -> None:
    """Count a loss, with the reason."""
    record.lost += 1
    record.remarks.append(words)


def _expect_refusal(rig: FocusRig, random: Random, record: FaultRecord, *codes: int) -> None:
    """A request that must be refused in words, with one of these codes, and must move nothing."""
    before = rig.frames
    state = rig.set_focus(rig.curvature(random))
    if state.error_code not in codes or not state.message:
        lost(record, f"must be refused with {codes}: error code {state.error_code}, {state.message!r}")
    time.sleep(0.1)
    if rig.frames != before:
        lost(record, "the mirror moved after a request that was refused")


# The calibration


@fault("the controller starts where there is no calibration; requests must be refused in words")
def no_calibration(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    rig.kill_controller()
    rig.withdraw_calibration()
    rig.capabilities.clear()
    rig.start_controller()
    rig.wait(lambda: rig.capabilities, "the capabilities of a new controller")
    _expect_refusal(rig, random, record, ErrorCode.NOT_CALIBRATED)
    rig.calibrate()


@fault("a calibration older than calibration_age_max: it serves, and every answer says that it is stale")
def stale_calibration(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    rig.publish_calibration(rig.calibration(id="old", checked=Time(sec=1)))
    rig.wait(lambda: rig.capabilities[-1].calibration_id == "old", "the old calibration")
    state = rig.set_focus(rig.curvature(random))
    if "stale" not in state.message or "stale" not in rig.capabilities[-1].message:
        lost(record, f"a stale calibration was used without a word: {state.message!r}")
    rig.account_for(state, record)
    rig.calibrate()


@fault("the calibration of another mirror, or one whose numbers make no sense, comes in the middle of a move")
def foreign_calibration(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    state = rig.set_focus(rig.far_curvature(random))
    wrong: dict[str, Any] = random.choice(
        ({"mirror_serial": "other"}, {"aperture_radius": 0.02}, {"influence_sag": [1.0]})
    )
    rig.publish_calibration(rig.calibration(id="foreign", **wrong))
    rig.wait(lambda: rig.capabilities[-1].quality == Capabilities.UNCALIBRATED, "the end of the calibration")
    rig.account_for(state, record)
    codes = ErrorCode.CALIBRATION_MISMATCH, ErrorCode.CALIBRATION_UNREADABLE
    _expect_refusal(rig, random, record, *codes)
    rig.calibrate()


@fault("the node that latches the calibration goes: the controller keeps what it has")
def calibration_vanishes(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    rig.withdraw_calibration()
    time.sleep(random.uniform(0.0, 0.5))
    for _ in range(3):
        rig.account_for(rig.set_focus(rig.curvature(random)), record)
    rig.calibrate()


# The driver


@fault("the driver is deactivated, or cleaned up, in the middle of a move")
def driver_inactive(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    states = [rig.set_focus(rig.far_curvature(random))]
    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    cleaned = random.random() < 0.5
    if cleaned:
        assert rig.change(Transition.TRANSITION_CLEANUP)
    # Whoever asks while the last report is on its way may be accepted; it must be told then.
    states.append(rig.set_focus(rig.curvature(random)))
    rig.wait_for_driver_state(ActuatorState.STATE_UNCONFIGURED if cleaned else ActuatorState.STATE_INACTIVE)
    _expect_refusal(rig, random, record, ErrorCode.DRIVER_INACTIVE)
    for state in states[1:]:
        rig.account_for(state, record)
    if cleaned:
        assert rig.change(Transition.TRANSITION_CONFIGURE)
    assert rig.change(Transition.TRANSITION_ACTIVATE)


def _without_driver(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    """Requests while there is no driver: each is told of as failed, and from driver_timeout on refused at once."""
    state = rig.set_focus(rig.curvature(random))
    rig.account_for(state, record)
    deadline = time.monotonic() + DRIVER_TIMEOUT_S + ANSWER_S
    while (state := rig.set_focus(rig.curvature(random))).error_code == ErrorCode.OK:
        if time.monotonic() > deadline:
            lost(record, "requests are accepted though there is no driver")
            return
        time.sleep(0.2)
    if state.error_code != ErrorCode.DRIVER_UNAVAILABLE or not state.message:
        lost(record, f"no driver: error code {state.error_code}, {state.message!r}")


@fault("kill -9 of the driver in the middle of a move that somebody waits for")
def driver_dies_in_move(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    _handle, result = rig.goal(MoveFocus, MoveFocus.Goal(request=FocusRequest(curvature=rig.far_curvature(random))))
    rig.wait_moving(random.randint(1, 6))
    rig.kill()
    rig.wait(result.done, "the result of the move", ANSWER_S)
    outcome = result.result().result
    if outcome.error_code == ErrorCode.OK:
        # The driver was quick enough to end the move; its last frames may still be on their way to the unit.
        rig.account_for(outcome.state, record)
    elif not outcome.message:
        lost(record, f"a move without driver: error code {outcome.error_code}, without a word")
    _without_driver(rig, random, record)
    rig.start()


@fault("SIGSTOP of the driver, requests meanwhile, SIGCONT")
def driver_stopped(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    rig.ask(rig.far_curvature(random))
    rig.wait_moving(random.randint(1, 6))
    rig.send_signal(signal.SIGSTOP)
    if random.random() < 0.5:
        _without_driver(rig, random, record)
    else:  # it goes on before anybody notices
        state = rig.set_focus(rig.curvature(random))
        time.sleep(random.uniform(0.0, 0.8 * DRIVER_TIMEOUT_S))
        rig.send_signal(signal.SIGCONT)
        rig.account_for(state, record)
    rig.send_signal(signal.SIGCONT)


@fault("SIGSTOP or kill -9 of the driver in the middle of a degauss that a request waits for")
def driver_gone_in_conditioning(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    state = rig.set_focus(rig.curvature(random), mode=FocusRequest.MODE_CONDITIONED)
    rig.wait_moving(random.randint(1, 40))
    kill = random.random() < 0.5
    if kill:
        rig.kill()
    else:
        rig.send_signal(signal.SIGSTOP)
    rig.account_for(state, record)
    if kill:
        rig.start()
    else:
        rig.send_signal(signal.SIGCONT)


@fault("SIGSTOP of the driver in the middle of a closed loop, which waits for its service")
def driver_stopped_in_loop(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    goal = Converge.Goal(request=FocusRequest(curvature=rig.far_curvature(random)), max_maps=20, tolerance=1e-10)
    _handle, result = rig.goal(Converge, goal)
    rig.wait_moving(random.randint(1, 4))
    rig.send_signal(signal.SIGSTOP)
    # The loop's own limit, converge.driver_timeout, ends it.
    rig.wait(result.done, "the result of the closed loop")
    outcome = result.result().result
    ended = outcome.error_code == ErrorCode.OK and rig.near(outcome.signals)  # before the driver was stopped
    if not ended and (outcome.error_code == ErrorCode.OK or not outcome.message):
        lost(record, f"a loop without driver: error code {outcome.error_code}, {outcome.message!r}")
    rig.send_signal(signal.SIGCONT)


# The clients


@fault(f"{CLIENTS} clients at once, in {CLIENT_PROCESSES} processes, and a stream of requests beside them", rounds=1)
def hundred_clients(rig: FocusRig, random: Random, record: FaultRecord) -> None:
    rig.focus_states.clear()
    command = [sys.executable, "-m", "fault_injection.rigs.focus_clients"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(rig.domain), "OPENBLAS_NUM_THREADS": "1"}
    clients = [
        subprocess.Popen(
            [*command, str(CLIENTS // CLIENT_PROCESSES), str(REQUESTS), str(random.randrange(10**6))],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        for _ in range(CLIENT_PROCESSES)
    ]
    deadline = time.monotonic() + CLIENTS_S
    try:
        while any(client.poll() is None for client in clients):
            if time.monotonic() > deadline:
                raise RigError(f"the clients have not got their answers within {CLIENTS_S:g} s")
            rig.ask(rig.curvature(random))
            time.sleep(0.02)
    finally:
        for client in clients:
            if client.poll() is None:
                client.kill()
    figures: Counter[str] = Counter()
    for client in clients:
        output, errors = client.communicate()
        if client.returncode != 0:
            raise RigError(f"clients: {errors[-500:]}")
        counts = json.loads(output.splitlines()[-1])
        curvatures = set(counts.pop("curvatures"))
        figures.update(counts)
        counts = Counter(state.curvature for state in list(rig.focus_states))
        figures["twice"] += sum(counts[curvature] > 1 for curvature in curvatures)
    unanswered = figures["asked"] - figures["answered"]
    if unanswered or figures["twice"] or figures["wrong"] or figures["wordless"]:
        record.lost += unanswered + figures["twice"] + figures["wrong"] + figures["wordless"]
        record.remarks.append(f"not answered {unanswered}, {dict(figures)}")


FAULTS: tuple[Fault, ...] = tuple(REGISTRY.values())
