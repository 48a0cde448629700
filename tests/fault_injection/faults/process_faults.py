"""Faults of the processes above the driver: each node in each state is killed, interrupted, and stopped for a while.

Harm is seen by the monitor at the electronics. Lost is an end that a caller cannot understand: an exit status that is
not 0 after Ctrl-C, an answer that never comes from a node that goes on, a node that does not work again.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from dm_msgs.action import Calibrate, MoveFocus
from dm_msgs.msg import ActuatorState, FocusRequest
from dm_msgs.srv import IngestFile, Measure

from fault_injection.fault import Fault, FaultRecord
from fault_injection.faults import bench_faults
from fault_injection.rigs.common_steps import checked
from fault_injection.rigs.driver_rig import ACTUATORS, RigError
from fault_injection.rigs.process_rig import CURVATURE, ProcessRig, calibrated_rig

#: Longest time for which a node is stopped, s.
STOPPED_S = 2.0
#: The longest that a calibration of pokes may take to its end, s: on an idle machine it is half a minute.
RUN_S = 300.0
#: Requests that wait while the interferometer reads; a service keeps ten.
FILES = 8
#: Requests at most until one that conditions the mirror is carried out, 0.1 s after each other.
TRIES = 50
#: Focus requests per second of a stream.
STREAM_HZ = 100.0

SIGNALS = {"kill -9": signal.SIGKILL, "Ctrl-C": signal.SIGINT, "SIGSTOP": signal.SIGSTOP}


@dataclass
class Activity:
    """What a node is doing when the signal comes.

    Attributes:
        answers: futures that a node that goes on must complete.
        stop: ends what the rig does meanwhile.
        after_interrupt: what must hold after Ctrl-C; a reason when it does not.
    """

    answers: list[Any] = field(default_factory=list)
    stop: Callable[[], None] = lambda: None
    after_interrupt: Callable[[], str] = lambda: ""


Begin = Callable[[ProcessRig, Random], Activity]
_STATES: list[tuple[str, str, Begin]] = []


def _state(node: str, words: str) -> Callable[[Begin], Begin]:
    """Register how `node` is brought into a state."""

    def register(begin: Begin) -> Begin:
        _STATES.append((node, words, begin))
        return begin

    return register


@_state("interferometer", "while it is idle")
def interferometer_idle(rig: ProcessRig, random: Random) -> Activity:
    return Activity()


@_state("interferometer", "while the instrument takes a map")
def interferometer_map_awaited(rig: ProcessRig, random: Random) -> Activity:
    rig.slow_instrument(0.7)
    answer = rig.begin(Measure, Measure.Request(timeout=30.0))
    time.sleep(random.uniform(0.1, 0.6))
    return Activity([answer], lambda: rig.slow_instrument(0.0))


@_state("interferometer", "while it reads files")
def interferometer_reading(rig: ProcessRig, random: Random) -> Activity:
    path = rig.bench.measure(rig.folder / "ingest.datx")
    answers = [rig.begin(IngestFile, IngestFile.Request(path=str(path))) for _ in range(FILES)]
    rig.wait(answers[random.randrange(FILES // 2)].done, "some files that are read")
    return Activity(answers)


@_state("calibration", "while it is idle")
def calibration_idle(rig: ProcessRig, random: Random) -> Activity:
    return Activity()


@_state("calibration", "in the middle of a run: the mirror is safe, and after Ctrl-C back at mid range")
def calibration_in_run(rig: ProcessRig, random: Random) -> Activity:
    steps: list[int] = []
    goal = Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, skip_degauss=True, settle_time=0.1)
    answer = rig.goal(Calibrate, goal, lambda message: steps.append(message.feedback.step))
    step = random.randint(1, 12)
    rig.wait(lambda: steps and steps[-1] >= step, f"step {step} of a calibration")
    rest = np.zeros(ACTUATORS)
    return Activity([answer], after_interrupt=lambda: "" if rig.stands_at(rest) else "not back at mid range")


@_state("focus_controller", "while it is idle")
def focus_controller_idle(rig: ProcessRig, random: Random) -> Activity:
    return Activity()


@_state("focus_controller", "in the middle of a move")
def focus_controller_in_move(rig: ProcessRig, random: Random) -> Activity:
    curvature = random.choice((-1.0, 1.0)) * random.uniform(0.5, 1.0) * CURVATURE
    answer = rig.goal(MoveFocus, MoveFocus.Goal(request=FocusRequest(curvature=curvature)))
    rig.wait_moving(1)
    return Activity([answer])


def _moved_or_ended(rig: ProcessRig, frames: int, answer: Any) -> Callable[[], bool]:
    """Whether so many frames have arrived, or a goal has ended before."""
    return lambda: rig.frames >= frames or bool(answer.done())


@_state("focus_controller", "in a move that conditions the mirror first")
def focus_controller_conditioning(rig: ProcessRig, random: Random) -> Activity:
    # A lost link makes the history unknown, so that conditioning is worth its time.
    rig.bench.electronics.set_plugged(False)
    rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
    rig.bench.electronics.set_plugged(True)
    rig.wait_for_driver_state(ActuatorState.STATE_ACTIVE)
    request = FocusRequest(curvature=random.uniform(-CURVATURE, CURVATURE), time_budget=120.0)
    moved = rig.frames + random.randint(1, 60)
    # The controller may hear that the link is up a moment after the rig does, and refuses until then.
    for _ in range(TRIES):
        answer = rig.goal(MoveFocus, MoveFocus.Goal(request=request))
        rig.wait(_moved_or_ended(rig, moved, answer), "a move under way")
        if rig.frames >= moved:
            return Activity([answer])
        time.sleep(0.1)
    raise RigError(f"not conditioned: {answer.result().result.message}")


@_state("focus_controller", f"with a stream of requests at {STREAM_HZ:g} Hz, which goes on meanwhile")
def focus_controller_streaming(rig: ProcessRig, random: Random) -> Activity:
    end = threading.Event()
    begun = time.monotonic()

    def publish() -> None:
        while not end.wait(1.0 / STREAM_HZ):
            phase = 2.0 * np.pi * (time.monotonic() - begun)
            rig.requests.publish(FocusRequest(curvature=float(CURVATURE * np.sin(phase))))

    thread = threading.Thread(target=publish)
    thread.start()

    def stop() -> None:
        end.set()
        thread.join()

    rig.wait_moving(random.randint(1, 30))
    return Activity(stop=stop)


def _fault(node: str, words: str, begin: Begin) -> Fault:
    """Every signal to `node` in the state that `begin` brings it into."""

    def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
        with calibrated_rig(folder, domain) as rig, checked(rig, record):
            for name, number in SIGNALS.items():
                activity = begin(rig, random)
                try:
                    wrong = _strike(rig, node, number, activity, random)
                finally:
                    activity.stop()
                if wrong:
                    record.lost += 1
                    record.remarks.append(f"{name}: {wrong}")
                record.injected += 1
                record.recovery_s.append(rig.all_works())

    return Fault(begin.__name__, f"kill -9, Ctrl-C and SIGSTOP of {node} {words}", run)


def _strike(rig: ProcessRig, node: str, number: int, activity: Activity, random: Random) -> str:
    """Send the signal, and start a node that ended again; what was wrong, "" when nothing was."""
    if number == signal.SIGSTOP:
        rig.processes[node].send_signal(signal.SIGSTOP)
        time.sleep(random.uniform(0.2, STOPPED_S))
        rig.processes[node].send_signal(signal.SIGCONT)
        for answer in activity.answers:
            rig.wait(answer.done, f"an answer of {node}, which went on", RUN_S)
        return ""
    status = rig.end_node(node, number)
    wrong = ""
    if number == signal.SIGINT:
        wrong = f"status {status}: {rig.log(node)}" if status else activity.after_interrupt()
    rig.start_node(node)
    return wrong


FAULTS: tuple[Fault, ...] = (*(_fault(*state) for state in _STATES), *bench_faults.FAULTS)
