"""What the buttons do: each function calls the nodes and returns its outcome in words."""

import asyncio
import dataclasses
import math
from typing import Any

import numpy as np
from dm_msgs.action import BuildRecipes, Calibrate, Converge, Degauss, MoveFocus
from dm_msgs.msg import FocusRequest
from dm_msgs.srv import Flatten, LoadCalibration, Measure, SetFocus, SetSignals

from dm_common.errors import ErrorCode, Refusal
from dm_common.optics.zernike import rms_beyond_tilt
from dm_tools.console.loops import effective_change, modelled_loop, modelled_way, way
from dm_tools.console.session import Session
from dm_tools.console.view_models import poke_signals, prediction_text

#: Wait between a command and its map, s: the default of the calibration's `settle_time`.
SETTLE_S = 0.5

#: Labels of the plans of a calibration.
PLANS = {
    Calibrate.Goal.PLAN_HYSTERESIS: "Hysteresis: influence function, hysteresis and creep",
    Calibrate.Goal.PLAN_FULL: "Full: pokes and the surfaces of Table 1",
    Calibrate.Goal.PLAN_POKES: "Pokes only",
    Calibrate.Goal.PLAN_SURFACES: "Surfaces of Table 1 only",
    Calibrate.Goal.PLAN_POKE_CHECK: "Poke check: wiring and orientation, nothing is stored",
}


async def predict(session: Session, request: FocusRequest) -> str:
    """The prediction for a request, in words; nothing moves. Raises Refusal."""
    answer = await session.ros.call("set_focus", SetFocus.Request(request=request, dry_run=True))
    return prediction_text(answer.state, session.snapshot().mirror_info)


async def move(session: Session, request: FocusRequest) -> str:
    """Move to the curvature of `request`."""
    result = await session.run("move_focus", MoveFocus.Goal(request=request))
    predicted = prediction_text(result.state, session.snapshot().mirror_info)
    return f"{request.curvature:+.4f} 1/m reached after {result.duration:.2f} s. {predicted}"


async def converge(session: Session, request: FocusRequest) -> str:
    """Correct the command on the interferometer until the surface is right."""
    result = await session.run("converge", Converge.Goal(request=request))
    figures = f"{result.residual_rms * 1e9:.1f} nm rms, largest coefficient {result.max_zernike * 1e9:.2f} nm"
    return f"{figures}, {result.maps} maps"


async def flatten(session: Session) -> str:
    """Make the surface flat."""
    answer = await session.ros.call("flatten", Flatten.Request())
    return prediction_text(answer.state, session.snapshot().mirror_info)


async def degauss(session: Session) -> str:
    """Wipe the history of the actuators."""
    answer = await session.run("degauss", Degauss.Goal())
    return f"done in {answer.duration:.1f} s; the mirror is at mid range"


async def measure(session: Session, label: str = "console") -> str:
    """Take one map."""
    answer = await session.ros.call("measure", Measure.Request(label=label), math.inf)
    rms = rms_beyond_tilt(answer.zernike.coefficients, answer.zernike.residual_rms)
    return f"rms beyond tilt {rms * 1e9:.1f} nm, valid {100 * answer.info.valid_fraction:.1f} % of the aperture"


async def calibrate(session: Session, goal: Calibrate.Goal) -> str:
    """Measure and store a calibration."""
    result = await session.run("calibrate", goal)
    findings = "".join(f" Poke check: {sentence}." for sentence in result.poke_findings)
    if result.poke_check_passed:
        findings = " Poke check passed: wiring and orientation are as configured."
    made = f"{result.id}: held-out residual {result.held_out_rms * 1e9:.1f} nm rms. " if result.id else ""
    return f"{made}{result.maps} maps, {result.maps_dropped} dropped.{findings} {result.warning}".rstrip()


async def estimate(session: Session, goal: Calibrate.Goal) -> str:
    """How long a calibration would take, and how good it would be; nothing moves."""
    goal.dry_run = True
    return str((await session.run("calibrate", goal)).message)


async def build_recipes(session: Session, goal: BuildRecipes.Goal) -> str:
    """Condition the mirror, then converge, for every shape of the goal; stored with the calibration in use."""
    result = await session.run("build_recipes", goal)
    return str(result.message)


async def load(session: Session, name: str) -> str:
    """Use a stored calibration."""
    answer = await session.ros.call("load_calibration", LoadCalibration.Request(calibration=name), 30.0)
    return str(answer.message)


def _mirror_and_signals(session: Session) -> tuple[Any, list[float]]:
    """mirror_info and the requested signals. Raises Refusal when the driver has not published them."""
    snapshot = session.snapshot()
    state, mirror = snapshot.actuator_state, snapshot.mirror_info
    if mirror is None or state is None:
        raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "the driver has not published its mirror and signals yet")
    requested = list(state.requested)
    if not requested:
        requested = [0.5 * (mirror.signal_min + mirror.signal_max)] * mirror.actuators
    return mirror, requested


async def _set_signals(session: Session, signals: list[float]) -> None:
    """Set all signals and wait, however long it takes, until the mirror has reached them. Raises Refusal."""
    await session.ros.call("set_signals", SetSignals.Request(signals=signals, wait=True), math.inf, again=True)


async def poke(session: Session, actuator: int, amplitude: float, then_measure: bool) -> str:
    """Move one actuator away from the shape before the first poke."""
    mirror, requested = _mirror_and_signals(session)
    base = session.base or requested
    signals = poke_signals(base, actuator, amplitude, mirror.signal_min, mirror.signal_max)
    await _set_signals(session, signals)
    session.poke = base, signals
    text = f"actuator {actuator} at {signals[actuator - 1]:+.3f}; release it with Escape"
    if not then_measure:
        return text
    await asyncio.sleep(SETTLE_S)
    return f"{text}. Map: {await measure(session, f'poke {actuator}')}"


async def release(session: Session) -> str:
    """Go back to the shape before the poke."""
    if (base := session.base) is None:
        return "nothing is poked"
    await _set_signals(session, base)
    session.poke = None
    return "back at the shape before"


async def measure_loop(session: Session, actuator: int, amplitude: float) -> str:
    """Take one actuator up and down with a map at every step; it ends where it began."""
    snapshot, (mirror, start) = session.snapshot(), _mirror_and_signals(session)
    calibration, observer = snapshot.calibration, session.ros.observer
    if calibration is None:
        raise Refusal(
            ErrorCode.NOT_CALIBRATED,
            "a measured loop needs a calibration: it holds what the actuator does to the surface",
        )
    settled = observer.now(snapshot.bench_time)
    state = observer.latest().state
    if settled.effective is None or state is None:
        raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, f"where the actuators stand is not known: {settled.doubt}")
    signals = way(start[actuator - 1], amplitude, mirror.signal_min, mirror.signal_max)
    first = float(settled.effective[actuator - 1])
    model = modelled_way(observer.law, state, actuator, signals)
    before = (await session.ros.call("measure", Measure.Request(label="loop start"), math.inf)).samples
    values: list[float] = []
    ours = True
    session.progress.steps = len(signals)
    try:
        for step, signal in enumerate(signals, start=1):
            if session.cancelled:
                raise Refusal(ErrorCode.CANCELED, "cancelled; the actuator is back where it began")
            session.progress.step, session.progress.text = step, f"actuator {actuator} at {signal:+.2f}"
            shape = [*start[: actuator - 1], signal, *start[actuator:]]
            await _set_signals(session, shape)
            await asyncio.sleep(SETTLE_S)
            after = (await session.ros.call("measure", Measure.Request(label=f"loop {step}"), math.inf)).samples
            if not np.array_equal(_mirror_and_signals(session)[1], shape):
                ours = False
                raise Refusal(ErrorCode.PREEMPTED, "the mirror was moved by somebody else; it stays where it is")
            values.append(first + effective_change(before, after, calibration, actuator))
    except (Refusal, ValueError):
        if ours:
            await _set_signals(session, start)
        raise
    loop = modelled_loop(observer.law, actuator, mirror.signal_min, mirror.signal_max)
    session.loops[calibration.id, actuator] = dataclasses.replace(
        loop, path=tuple(signals), modelled_path=tuple(model), measured=tuple(values)
    )
    gap = float(np.abs(np.array(values) - np.array(model)).max())
    return f"actuator {actuator}: model and maps differ by at most {gap:.4f} of a signal"
