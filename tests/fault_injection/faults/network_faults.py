"""Faults of the network between the driver's host and the controller's, each in a process of its own.

    python -m fault_injection.faults.network_faults NAME FOLDER DOMAIN SEED

injects one and prints its record as a line of JSON.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from random import Random

from dm_msgs.action import MoveFocus
from dm_msgs.msg import Capabilities, ErrorCode, FocusRequest, FocusState

from fault_injection.fault import Fault, FaultRecord
from fault_injection.rigs.common_steps import checked
from fault_injection.rigs.driver_rig import RigError
from fault_injection.rigs.focus_rig import ANSWER_S, DRIVER_TIMEOUT_S
from fault_injection.rigs.network_rig import NetworkRig
from studies.network_namespaces import NotPermittedError

LOSS, DELAY_S = 0.05, 0.05
#: Requests while the network is bad, and the time between two, s.
REQUESTS, PERIOD_S = 30, 0.1
#: DDS repeats what was lost when it hears that it is missing, which takes up to this time in bad cases, s.
REPEATED_S = 20.0
#: Cuts of the cable, s: unnoticed; longer than the driver may be silent; longer than DDS remembers a neighbour.
CUTS_S = (0.5, 2.0 * DRIVER_TIMEOUT_S, 25.0)

#: Longest time that one fault may take in all, s.
FAULT_S = 600.0

Injection = Callable[[NetworkRig, Random, FaultRecord], None]
_INJECTIONS: dict[str, tuple[Injection, int]] = {}
_REGISTRY: dict[str, Fault] = {}


def fault(words: str, rounds: int = 2) -> Callable[[Injection], Injection]:
    """Register an injection into two hosts that work, under its function's name."""

    def register(inject: Injection) -> Injection:
        name = inject.__name__

        def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
            _run_apart(name, folder, domain, random.randrange(10**9), record)

        _INJECTIONS[name] = inject, rounds
        _REGISTRY[name] = Fault(name, words, run)
        return inject

    return register


def _run_apart(name: str, folder: Path, domain: int, seed: int, record: FaultRecord) -> None:
    """Inject in a fresh process and add what it tells to `record`.

    Raises:
        NotPermittedError: this machine does not let us make hosts.
        RigError: the process failed.
    """
    command = [sys.executable, "-m", "fault_injection.faults.network_faults", name, str(folder), str(domain), str(seed)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        output, errors = process.communicate(timeout=FAULT_S)
    except BaseException:
        process.send_signal(signal.SIGINT)  # it takes its hosts and nodes along
        process.communicate(timeout=60.0)
        raise
    if process.returncode != 0:
        raise RigError(errors.strip()[-800:])
    result = FaultRecord(**json.loads(output.splitlines()[-1]))
    if result.skipped:
        raise NotPermittedError(result.skipped)
    record.injected += result.injected
    record.limit_violations += result.limit_violations
    record.lost += result.lost
    record.recovery_s += result.recovery_s
    record.remarks += result.remarks


def main() -> int:
    """Inject one fault; exit status 0 with its record."""
    name, folder, domain, seed = sys.argv[1:5]
    inject, rounds = _INJECTIONS[name]
    record, random = FaultRecord(name), Random(int(seed))
    try:
        with NetworkRig(Path(folder), int(domain), random) as rig, checked(rig, record):
            rig.refocus(random)
            for _ in range(rounds):
                inject(rig, random, record)
                rig.mend()
                record.injected += 1
                record.recovery_s.append(rig.refocus(random))
    except NotPermittedError as reason:
        record.skipped = str(reason)
    except RigError as error:
        record.lost += 1
        record.remarks.append(str(error))
    print(json.dumps(asdict(record)), flush=True)
    return 0


def _requests(rig: NetworkRig, random: Random, record: FaultRecord) -> None:
    """A stream of requests; the last one must stand, or be told of as failed."""
    state: FocusState | None = None
    for _ in range(REQUESTS):
        state = rig.set_focus(rig.curvature(random))
        if state.error_code != ErrorCode.OK and not state.message:
            record.lost += 1
            record.remarks.append(f"refused without a word: error code {state.error_code}")
        time.sleep(random.uniform(0.0, 2.0 * PERIOD_S))
    assert state is not None
    rig.account_for(state, record, REPEATED_S)


@fault(f"{LOSS:.0%} of all frames are lost, in both directions")
def frames_lost(rig: NetworkRig, random: Random, record: FaultRecord) -> None:
    rig.netem.loss = LOSS
    _requests(rig, random, record)


@fault(f"every frame takes {DELAY_S * 1e3:.0f} ms, in each direction")
def frames_delayed(rig: NetworkRig, random: Random, record: FaultRecord) -> None:
    rig.netem.delay_s = DELAY_S
    _requests(rig, random, record)


@fault("the cable is cut in the middle of a move, for half a second to longer than DDS remembers, and mended", rounds=3)
def partition(rig: NetworkRig, random: Random, record: FaultRecord) -> None:
    goal = MoveFocus.Goal(request=FocusRequest(curvature=rig.far_curvature(random)))
    _handle, result = rig.goal(MoveFocus, goal)
    rig.wait_moving(random.randint(1, 4))
    rig.netem.plugged = False
    end = time.monotonic() + CUTS_S[record.injected % len(CUTS_S)]
    states = [rig.set_focus(rig.curvature(random))]
    while time.monotonic() < end:
        states.append(rig.set_focus(rig.curvature(random)))
        time.sleep(min(PERIOD_S, max(end - time.monotonic(), 0.0)))
    rig.netem.plugged = True
    rig.wait(result.done, "the result of the move", ANSWER_S)
    outcome = result.result().result
    if outcome.error_code != ErrorCode.OK and not outcome.message:
        record.lost += 1
        record.remarks.append(f"a move ended without a word: error code {outcome.error_code}")
    accepted = [state for state in states if state.error_code == ErrorCode.OK]
    if accepted:  # the latest wins: what came before it was replaced
        rig.account_for(accepted[-1], record, REPEATED_S)


@fault(f"a controller that starts late must get what is latched, through {LOSS:.0%} loss and {DELAY_S * 1e3:.0f} ms")
def late_joiner(rig: NetworkRig, random: Random, record: FaultRecord) -> None:
    rig.kill_controller()
    rig.capabilities.clear()
    rig.netem.loss, rig.netem.delay_s = LOSS, DELAY_S
    rig.start_controller()
    begun = time.monotonic()
    try:
        rig.wait(
            lambda: rig.capabilities and rig.capabilities[-1].quality == Capabilities.CALIBRATED,
            "the latched calibration",
        )
    except RigError as error:
        record.lost += 1
        record.remarks.append(f"late joiner: {error}")
    else:
        record.remarks.append(f"calibrated {time.monotonic() - begun:.1f} s after the start")


FAULTS: tuple[Fault, ...] = tuple(_REGISTRY.values())


if __name__ == "__main__":
    sys.exit(main())
