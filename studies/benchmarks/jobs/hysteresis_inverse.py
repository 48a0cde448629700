"""The inverse of identified hysteresis models, beside the linear solve with clipping; its growth with actuators."""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from dm_common.hysteresis.inverse import invert
from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.limits import Limits
from dm_controller.planning.fast_path import PreparedInverse
from dm_controller.planning.mirror_model import CalibratedMirror
from dm_controller.planning.planner import SETTLE_S, Planner
from dm_controller.planning.target import FocusTarget
from studies.benchmarks import stand_in_mirror
from studies.benchmarks.jobs.scaling import ACTUATORS
from studies.benchmarks.timing import Effort, medians

#: Number of earlier moves, and time after the last of them at which the inverse is computed, s.
MOVES, DELAY_S = 12, 10.0
REACH = 0.03  # 1/m
#: Amplitudes of earlier moves and of aims: inside the limits, so that no branch of code is left out or always taken.
SWING, AIM = 0.7, 0.6


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figures `inverse` (ms: the slowest class of law, 37 actuators) and `inverse_growth`."""
    generator = np.random.default_rng(3)
    laws = {name: stand_in_mirror.identified_law(name) for name in stand_in_mirror.SIMULATED_LAWS}
    mirror = CalibratedMirror(stand_in_mirror.influence_model(), Limits(-1.0, 1.0, np.zeros((0, 2), np.intp), 2.0))
    by_law = {name: _law(law, mirror, effort, generator) for name, law in laws.items()}
    growth = [_growth(count, laws, effort, generator) for count in (ACTUATORS[:3] if effort.quick else ACTUATORS)]
    sizes = np.log([entry["actuators"] for entry in growth])
    slopes = {name: float(np.polyfit(sizes, np.log([entry[name] for entry in growth]), 1)[0]) for name in laws}
    slowest = max(by_law, key=lambda name: by_law[name]["ms"])
    return {
        "inverse": {"ms": by_law[slowest]["ms"], "linear_ms": by_law[slowest]["linear_ms"], "laws": by_law},
        "inverse_growth": {"sizes": growth, "exponents": slopes},
    }


def _state(law: HysteresisModel, actuators: int, generator: np.random.Generator) -> HysteresisState:
    state = law.demagnetised(actuators, 0.0)
    for number in range(MOVES):
        state = law.move(state, generator.uniform(-SWING, SWING, actuators), float(number))
    return state


def _law(
    law: HysteresisModel, mirror: CalibratedMirror, effort: Effort, generator: np.random.Generator
) -> dict[str, float]:
    """Times in ms for one law; `worst_signal` is the largest difference of the prepared inverse from the other."""
    state = _state(law, 37, generator)
    start = state.time + DELAY_S
    at = law.advance(state, start)
    aims = iter(generator.uniform(-AIM, AIM, (20 * effort.rounds + 100, 37)))
    curvatures = iter(generator.uniform(-REACH, REACH, 20 * effort.rounds + 100))
    ready = PreparedInverse(law, state, Limits())
    cold, warm = (Planner(mirror, stand_in_mirror.figures(law)) for _ in range(2))
    warm.prepare(state)
    model = mirror.model
    gain = np.linalg.pinv(model.influence_zernike[3:])
    wanted = FocusTarget(REACH).coefficients(model.aperture_radius)[3:]
    jobs = {
        "ms": lambda: invert(law, at, next(aims), -1.0, 1.0, SETTLE_S),
        "prepared_ms": lambda: ready.invert(start, next(aims), SETTLE_S),
        "prepare_ms": lambda: PreparedInverse(law, state, Limits()),
        "plan_ms": lambda: cold.plan(FocusTarget(next(curvatures)), state, start, ahead=SETTLE_S).signals,
        "plan_prepared_ms": lambda: warm.plan(FocusTarget(next(curvatures)), state, start, ahead=SETTLE_S).signals,
        "linear_ms": lambda: np.clip(gain @ wanted, -1.0, 1.0),
    }
    result = {name: 1e3 * seconds for name, seconds in medians(jobs, 5 * effort.rounds).items()}
    aim = next(aims)
    prepared = ready.invert(start, aim, SETTLE_S)
    difference = 0.0 if prepared is None else np.abs(prepared - invert(law, at, aim, -1.0, 1.0, SETTLE_S).signals).max()
    reached = law.effective(
        law.advance(law.move(at, invert(law, at, aim, -1.0, 1.0, SETTLE_S).signals, start), start + SETTLE_S)
    )
    return result | {"worst_signal": float(difference), "worst_effective": float(np.abs(reached - aim).max())}


def _growth(
    actuators: int, laws: dict[str, HysteresisModel], effort: Effort, generator: np.random.Generator
) -> dict[str, float]:
    entry: dict[str, float] = {"actuators": actuators}
    for name, law in laws.items():
        at = law.advance(_state(law, actuators, generator), MOVES + DELAY_S)
        aim = generator.uniform(-AIM, AIM, actuators)
        job = partial(invert, law, at, aim, -1.0, 1.0, SETTLE_S)
        entry[name] = 1e3 * medians({"x": job}, effort.rounds)["x"]
    return entry
