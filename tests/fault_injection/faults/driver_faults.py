"""Faults around the driver: its process, the wire, the commands and the clock."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from dm_msgs.msg import ActuatorCommand, ActuatorState, ErrorCode
from dm_msgs.srv import SetSignals
from lifecycle_msgs.msg import Transition
from numpy.typing import NDArray
from rosgraph_msgs.msg import Clock

from fault_injection.fault import Fault, FaultRecord
from fault_injection.rigs.common_steps import begin_degauss, checked, other_client
from fault_injection.rigs.driver_rig import ACTUATORS, DriverRig

ROUNDS = 3  # injections per start of a driver, where one driver can take several

#: A fault, injected into a rig whose driver is active and rests.
Injection = Callable[[DriverRig, Random, FaultRecord], None]

REGISTRY: dict[str, Fault] = {}


def shape(random: Random) -> NDArray[np.float64]:
    """(37,) legal signals: anywhere in the range, neighbours no further apart than allowed."""
    middle = random.uniform(-0.6, 0.6)
    return np.array([middle + random.uniform(-0.4, 0.4) for _ in range(ACTUATORS)])


def far_shape(rig: DriverRig, random: Random) -> NDArray[np.float64]:
    """A legal shape so far away that the way takes many frames."""
    side = -1.0 if rig.signals.mean() > 0 else 1.0
    return side * np.array([random.uniform(0.75, 1.0) for _ in range(ACTUATORS)])


def fault(words: str, rounds: int = ROUNDS, **rig_options: Any) -> Callable[[Injection], Injection]:
    """Register an injection under its function's name; each of `rounds` is followed by a recovery."""

    def register(inject: Injection) -> Injection:
        def run(folder: Path, domain: int, random: Random, record: FaultRecord) -> None:
            with DriverRig(folder, domain, **rig_options) as rig:
                with checked(rig, record):
                    rig.recover(shape(random))
                    for _ in range(rounds):
                        inject(rig, random, record)
                        record.injected += 1
                        record.recovery_s.append(rig.recover(shape(random)))

        name = inject.__name__
        REGISTRY[name] = Fault(name, words, run)
        return inject

    return register


# The process


def _restart(rig: DriverRig) -> None:
    """A new driver, as a supervisor would start it; how long it takes is part of the recovery."""
    rig.start()


@fault("kill -9 of the driver while the mirror rests in some shape")
def driver_killed_at_rest(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.kill()
    _restart(rig)


@fault("kill -9 of the driver in the middle of a move")
def driver_killed_in_move(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.publish(far_shape(rig, random))
    rig.wait_moving(random.randint(1, 6))
    rig.kill()
    _restart(rig)


@fault("kill -9 of the driver in the middle of a degauss")
def driver_killed_in_degauss(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    begin_degauss(rig, 40)
    rig.wait_moving(random.randint(5, 40))
    rig.kill()
    _restart(rig)


@fault("kill -9 of a driver that is configured but not active, and of one that is not configured", rounds=2)
def driver_killed_inactive(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    if random.random() < 0.5:
        assert rig.change(Transition.TRANSITION_CLEANUP)
    rig.kill()
    _restart(rig)


@fault("Ctrl-C in the middle of a move: the driver must end in the safe shape")
def driver_interrupted_in_move(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.publish(far_shape(rig, random))
    rig.wait_moving()
    status = rig.kill(signal.SIGINT)
    if status != 0 or not rig.stands_at(np.full(ACTUATORS, -1.0)):
        record.lost += 1
        record.remarks.append(f"Ctrl-C: status {status}, safe shape reached: {rig.stands_at(np.full(ACTUATORS, -1.0))}")
    _restart(rig)


@fault("SIGSTOP of the driver in the middle of a move, commands meanwhile, SIGCONT")
def driver_stopped_in_move(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.publish(far_shape(rig, random))
    rig.wait_moving()
    rig.send_signal(signal.SIGSTOP)
    for _ in range(20):
        rig.publish(shape(random), rig.node.get_clock().now().nanoseconds)
        time.sleep(random.uniform(0.0, 0.1))
    rig.send_signal(signal.SIGCONT)


# The wire


@fault("cable pulled while the mirror rests, and put back")
def unplugged_at_rest(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.bench.electronics.set_plugged(False)
    rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
    rig.bench.electronics.set_plugged(True)


@fault("cable pulled in the middle of a move, and put back")
def unplugged_in_move(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    future = rig.begin(SetSignals, SetSignals.Request(signals=far_shape(rig, random).tolist(), wait=True))
    rig.wait_moving(random.randint(1, 6))
    rig.bench.electronics.set_plugged(False)
    rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
    if rig.wait_answer(future).error_code != ErrorCode.ELECTRONICS_UNREACHABLE:
        record.lost += 1
        record.remarks.append("a move that was cut off was reported as carried out")
    rig.bench.electronics.set_plugged(True)


@fault("the unit accepts the connection but reads nothing for a while, in the middle of a move")
def unit_silent(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.publish(far_shape(rig, random))
    rig.wait_moving()
    rig.silent(random.uniform(0.3, 2.0)).join()


@fault("the unit takes one frame now and then, in the middle of a move")
def unit_slow(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.publish(far_shape(rig, random))
    rig.wait_moving()
    for _ in range(15):
        rig.silent(0.05).join()


@fault("another program holds the unit's only TCP connection when the driver starts")
def second_client(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.kill()
    with other_client(rig):
        rig.start()
        rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)


@fault("the serial port vanishes in the middle of a move and comes back under another name", kind="usb_dac40")
def serial_port_renamed(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    link = rig.folder / "ttyUSB"
    before = link.readlink()
    rig.publish(far_shape(rig, random))
    rig.wait_moving()
    rig.bench.electronics.set_plugged(False)
    rig.wait_for_driver_state(ActuatorState.STATE_LINK_LOST)
    taken = list(os.openpty())  # so that the old name is not given again
    while len(taken) < 200 and os.ttyname(taken[-1]) != str(before):
        taken += os.openpty()
    rig.bench.electronics.set_plugged(True)
    if link.readlink() == before:
        record.remarks.append(f"the name {before} was given again")
    for descriptor in taken:
        os.close(descriptor)


# The commands


def _other_publisher(rig: DriverRig) -> Any:
    return rig.node.create_publisher(ActuatorCommand, "actuator_command", rig.publisher.qos_profile)


@fault("another publisher sends other shapes to the command topic in turn with ours")
def foreign_publisher(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    other = _other_publisher(rig)
    for _ in range(100):
        rig.publish(shape(random))
        theirs = far_shape(rig, random) if random.random() < 0.1 else shape(random)
        other.publish(ActuatorCommand(signals=theirs.tolist()))
        time.sleep(random.uniform(0.0, 0.01))
    rig.node.destroy_publisher(other)


@fault("commands at 10 kHz for a second")
def command_flood(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    shapes = [shape(random) for _ in range(50)]
    begun = time.monotonic()
    for number in range(10_000):
        rig.publish(shapes[number % 50])
        ahead = begun + number * 1e-4 - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)


@fault("a thousand commands at once")
def command_burst(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    shapes = [shape(random) for _ in range(1000)]
    for each in shapes:
        rig.publish(each)


@fault("NaN, infinities, denormals, wrong lengths, values and differences just beyond their limits, wrong stamps")
def senseless_commands(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    rig.recover(np.zeros(ACTUATORS))
    frames = rig.frames
    now = rig.node.get_clock().now().nanoseconds
    for bad in (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, np.nextafter(1.0 + 1e-8, 2.0), 1.001):
        signals = np.zeros(ACTUATORS)
        signals[random.randrange(ACTUATORS)] = bad
        rig.publish(signals)
    step = np.zeros(ACTUATORS)
    step[0] = 1.0
    step[1:7] = -1e-6  # neighbours of actuator 1, just too far away
    rig.publish(step)
    for length in (0, 1, 36, 38, 10_000):
        rig.publish(np.zeros(length) + 0.5)
    for offset_s in (-1e6, -5, 5, 1e6):
        rig.publish(np.full(ACTUATORS, 0.5), now + int(offset_s * 1e9))
    time.sleep(0.5)
    if rig.frames != frames or not rig.stands_at(np.zeros(ACTUATORS)):
        record.lost += 1
        record.remarks.append(f"{rig.frames - frames} frames after commands that must be refused")
    for legal in (np.full(ACTUATORS, 5e-324), np.full(ACTUATORS, 1.0), np.full(ACTUATORS, -1.0)):
        rig.recover(legal)


@fault("the clock jumps forwards and back by seconds to days, commands go on", use_sim_time=True)
def clock_jumps(rig: DriverRig, random: Random, record: FaultRecord) -> None:
    clock = rig.node.create_publisher(Clock, "/clock", 10)
    for jump_s in (0.0, 3.0, -7.0, 86400.0, -86400.0, 0.2):
        stamp_ns = int((1e9 + jump_s) * 1e9)
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        clock.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
        for _ in range(5):
            rig.publish(shape(random), stamp_ns + int(random.uniform(-3, 3) * 1e9))
            time.sleep(random.uniform(0.0, 0.03))
    rig.node.destroy_publisher(clock)


def select(names: str) -> list[Fault]:
    """The faults with these comma-separated names; all for an empty string.

    Raises:
        ValueError: no such fault.
    """
    wanted = [name.strip() for name in names.split(",") if name.strip()] or list(REGISTRY)
    unknown = [name for name in wanted if name not in REGISTRY]
    if unknown:
        raise ValueError(f"faults = {', '.join(unknown)}: must be among {', '.join(REGISTRY)}")
    return [REGISTRY[name] for name in wanted]
