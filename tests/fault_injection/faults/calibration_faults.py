"""Faults in the middle of a calibration: the same goal, sent again, must end as if nothing had happened.

Lost is a state of the plan that is not in the stored calibration, or is there twice; a map whose bits are not those
that were kept when it was measured; a map measured again without a reason; a run that does not end well.
"""

from __future__ import annotations

import re
import resource
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from dm_msgs.action import Calibrate
from dm_msgs.msg import ErrorCode

from dm_calibration.procedure.run_journal import read_run
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.ros.clients import ThreadedActionClient
from fault_injection.fault import Fault, FaultRecord
from fault_injection.rigs.common_steps import checked
from fault_injection.rigs.driver_rig import RigError
from fault_injection.rigs.process_rig import ProcessRig
from map_hashes import map_hashes, record_hash

#: Push and pull of 37 actuators, a reference frame before each ten and at the end.
STATES = 2 * 37 + 9
#: Longest time for a run, s.
RUN_S = 300.0
#: Tilt of a bumped mirror at the edge, m.
BUMP = 10e-6

_NODES = ("interferometer", "calibration")


class _Runs:
    """The calibrations of one rig: every goal is the same."""

    def __init__(self, rig: ProcessRig, record: FaultRecord) -> None:
        self.rig, self.record = rig, record
        self.feedback: list[Any] = []
        self.before = rig.bench.maps_written
        self._client = ThreadedActionClient(rig.node, Calibrate, "calibrate")
        self._handle: Any = None
        self._result: Any = None

    def start(self) -> None:
        """Send the goal."""
        self.feedback = []
        self.rig.wait(self._client.server_is_ready, "the action calibrate")
        accepted = self._client.send_goal_async(
            Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES),
            feedback_callback=lambda message: self.feedback.append(message.feedback),
        )
        self.rig.wait(accepted.done, "the acceptance of a goal")
        self._handle = accepted.result()
        self._result = self._handle.get_result_async()

    def cancel(self) -> None:
        """Cancel the goal."""
        self._handle.cancel_goal_async()

    def wait_step(self, step: int) -> None:
        """Wait until the run is at `step` of its plan, or has ended."""
        self.rig.wait(
            lambda: self._result.done() or (self.feedback and self.feedback[-1].step >= step), f"step {step}", RUN_S
        )
        if self._result.done():
            raise RigError(f"the run ended before step {step}: {self._result.result().result.message}")

    def end(self) -> Any:
        """The result of the run."""
        self.rig.wait(self._result.done, "the end of a run", RUN_S)
        return self._result.result().result

    def kept(self) -> dict[str, str]:
        """Hashes of the maps that the unfinished run holds, by label."""
        folder = self.rig.calibrations / "unfinished"
        runs = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
        if len(runs) != 1:
            raise RigError(f"{len(runs)} unfinished runs: there must be one")
        return {record.label: record_hash(record) for record in read_run(runs[0]).outcome.records}

    def restart(self, *names: str) -> None:
        """Start nodes again that were killed; wait until they answer."""
        for name in names:
            self.rig.start_node(name)
        self.rig.all_works()
        time.sleep(1.0)  # until the new action server and its client know each other; no API tells

    def finish(self, kept: dict[str, str], again: int = 0, begun: float | None = None) -> None:
        """Send the goal once more and judge its result; `again` maps may be measured a second time."""
        begun = time.monotonic() if begun is None else begun
        self.start()
        self.wait_step(1)
        self.record.recovery_s.append(time.monotonic() - begun)
        result = self.end()
        if result.error_code != ErrorCode.OK:
            raise RigError(f"the resumed run: {result.message}")
        maps = CalibrationStore(self.rig.calibrations).load(result.id).maps
        hashes = dict(zip(maps.label, map_hashes(maps), strict=True))
        states = Counter(label for label in maps.label if "resumed" not in label)
        wrong = [label for label, digest in kept.items() if hashes.get(label) != digest]
        lost = max(0, STATES - len(states) - len(result.dropped)) + sum(states.values()) - len(states) + len(wrong)
        extra = self.rig.bench.maps_written - self.before - len(maps) - again
        if lost or extra > 0:
            self.record.lost += lost + max(extra, 0)
            self.record.remarks.append(
                f"{len(states)} of {STATES} states, {len(wrong)} maps other than kept, {extra} measured twice"
            )


@contextmanager
def _runs(folder: Path, domain: int, record: FaultRecord) -> Iterator[_Runs]:
    with ProcessRig(folder, domain, _NODES, limits__slew_rate=40.0, degauss__steps=20) as rig, checked(rig, record):
        rig.all_works()
        yield _Runs(rig, record)


Injection = Callable[[_Runs, Random], None]
_FAULTS: list[Fault] = []


def _fault(words: str) -> Callable[[Injection], Injection]:
    """Register an injection under its function's name; it is called with a run about to begin."""

    def register(inject: Injection) -> Injection:
        def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
            with _runs(folder, domain, record) as runs:
                runs.start()
                inject(runs, random)

        _FAULTS.append(Fault(inject.__name__, words, run))
        return inject

    return register


@_fault("kill -9 of the calibration node in the degauss and at three other steps of one run")
def calibration_killed(runs: _Runs, random: Random) -> None:
    rig = runs.rig
    rig.wait_moving(10)
    again = 0
    kept: dict[str, str] = {}
    steps = sorted(random.sample(range(2, STATES - 5), 3))
    for step in (0, *steps):
        if step:
            runs.start()
            runs.wait_step(step)
            time.sleep(random.uniform(0.0, 0.3))
        begun = time.monotonic()
        rig.end_node("calibration", signal.SIGKILL)
        runs.record.injected += 1
        if step:
            kept = runs.kept()
            again += 1  # the map under way never came to the node
        runs.restart("calibration")
        again += 1  # by which the rig asked whether all works
        runs.record.recovery_s.append(time.monotonic() - begun)
    del runs.record.recovery_s[-1]
    runs.finish(kept, again, begun)


@_fault("power cut: kill -9 of calibration, interferometer and driver at once")
def calibration_power_cut(runs: _Runs, random: Random) -> None:
    runs.wait_step(random.randint(2, STATES - 5))
    rig = runs.rig
    begun = time.monotonic()
    for name in _NODES:
        rig.end_node(name, signal.SIGKILL)
    rig.kill()
    runs.record.injected += 1
    kept = runs.kept()
    rig.start()
    runs.restart(*_NODES)
    runs.finish(kept, 2, begun)


@_fault("kill -9 of the driver in the middle of a run")
def calibration_driver_killed(runs: _Runs, random: Random) -> None:
    runs.wait_step(random.randint(2, STATES - 5))
    begun = time.monotonic()
    runs.rig.kill()
    runs.record.injected += 1
    runs.rig.start()
    _stopped(runs, "")
    kept = runs.kept()
    runs.restart()
    runs.finish(kept, 3, begun)


@_fault("kill -9 of the interferometer in the middle of a run")
def calibration_interferometer_killed(runs: _Runs, random: Random) -> None:
    runs.wait_step(random.randint(2, STATES - 15))
    begun = time.monotonic()
    runs.rig.end_node("interferometer", signal.SIGKILL)
    runs.record.injected += 1
    runs.rig.start_node("interferometer")
    result = runs.end()  # a map or two are tried again; the run goes on when the node is back in time
    if result.error_code == ErrorCode.OK:
        runs.record.recovery_s.append(time.monotonic() - begun)
        return
    kept = runs.kept()
    runs.restart()
    runs.finish(kept, 12, begun)


@_fault("the disk is full in the middle of a run")
def calibration_disk_full(runs: _Runs, random: Random) -> None:
    rig = runs.rig
    runs.wait_step(random.randint(2, STATES - 5))
    process = rig.processes["calibration"].pid
    begun = time.monotonic()
    resource.prlimit(process, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    runs.record.injected += 1
    _stopped(runs, "could not be stored")
    resource.prlimit(process, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    runs.finish(runs.kept(), 1, begun)


@_fault("the mirror is bumped in the middle of a run, and put back")
def calibration_bumped(runs: _Runs, random: Random) -> None:
    runs.wait_step(random.randint(2, STATES - 15))
    instrument = runs.rig.bench.interferometer
    good = instrument.measure

    def bumped(displacement: Any, time: float = 0.0) -> Any:
        sag = good(displacement, time)
        return sag + BUMP * np.linspace(-1.0, 1.0, len(sag))[:, np.newaxis]

    begun = time.monotonic()
    instrument.measure = bumped  # type: ignore[method-assign]
    runs.record.injected += 1
    _stopped(runs, "was bumped")
    instrument.measure = good  # type: ignore[method-assign]
    runs.finish(runs.kept(), 14, begun)  # those since the last good reference frame are in doubt


@_fault("maps of another wavelength in the middle of a run")
def calibration_other_wavelength(runs: _Runs, random: Random) -> None:
    instrument = runs.rig.bench.interferometer
    runs.wait_step(random.randint(2, STATES - 15))
    begun, good = time.monotonic(), instrument.config
    instrument.config = replace(good, wavelength=635e-9)
    runs.record.injected += 1
    _stopped(runs, "wavelength 635.000 nm")
    instrument.config = good
    runs.finish(runs.kept(), 8, begun)  # refused ones are measured again


@_fault("the operator cancels, and starts again")
def calibration_cancelled(runs: _Runs, random: Random) -> None:
    runs.wait_step(random.randint(2, STATES - 5))
    begun = time.monotonic()
    runs.cancel()
    runs.record.injected += 1
    _stopped(runs, "the mirror is back at mid range")
    runs.finish(runs.kept(), 1, begun)


def _stopped(runs: _Runs, words: str) -> None:
    """The run must end by itself, say why, and keep what it measured."""
    result = runs.end()
    kept = re.search(r"\bmap( is|s are) kept in", result.message)
    if result.error_code == ErrorCode.OK or words not in result.message or not kept:
        runs.record.lost += 1
        runs.record.remarks.append(f"code {result.error_code}: {result.message}")


FAULTS = tuple(_FAULTS)
