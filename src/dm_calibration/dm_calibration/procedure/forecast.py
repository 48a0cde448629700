"""Duration and accuracy of a hysteresis plan, estimated before anything moves."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit, few_maps, fit_hysteresis
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import Plan, StepKind
from dm_common import Floats
from dm_common.figures import distinct_from, in_nanometres, rounded
from dm_common.limits import Limits
from dm_common.mirror import Mirror

#: A run no longer improves if this number of parts together lowers the error by less than this share.
STANDSTILL_PARTS, STANDSTILL = 2, 0.05
#: Power with which the error grows where the maps are few: the median of five mirrors (seeds 7646, 7650, 7655, 7684 and
#: 7688) was 55 nm after 90 maps, 9.4, 7.1 and 2.2 nm after 112, 133 and 216.
FEWER = 3
#: A degauss of 100 half-swings takes 2.5 s on the simulation, 10 s at the slew rate that ships for hardware.
TYPICAL_DEGAUSS_S = 5.0
#: Range that a degauss of 100 half-swings travels, normalised.
DEGAUSS_TRAVEL = 100.0
#: A fit after a part of a run with `until` took 12 to 25 s of one core for 37 actuators and 90 to 400 maps.
TYPICAL_FIT_S = 18.0
#: Error of moves after a run of one map per actuator, for a mirror never calibrated, m, as in :attr:`LawError.first`.
#: Median of 29 mirrors drawn at random (seeds 7646 to 7675 without 7650): 1.5 nm after 314 maps. One mirror in ten
#: reached only 3.0 nm.
TYPICAL_LAW = 4.5e-9
#: If the error in a run exceeds the typical one by more than this factor, the law has probably not been found yet.
WORST_LAW = 2.2


@dataclass(frozen=True)
class Forecast:
    """Expected duration and accuracy of a plan.

    Attributes:
        duration: s.
        max_zernike: m, error of moves, as `HysteresisFit.held_out_max_zernike`; 0 = not known.
        maps: number of maps; 0 = all of the plan.
        typical: whether `max_zernike` is that of mirrors drawn at random: the law of this one was never measured.
    """

    duration: float
    max_zernike: float
    maps: int = 0
    typical: bool = False

    def accuracy(self, until: float) -> str:
        """A phrase on the expected accuracy, compared with the goal `until` (m; 0 = no goal); "" = it is not known."""
        if not self.max_zernike > 0.0:
            return ""
        missed = f" not expected to reach {in_nanometres(until)}:" if self.max_zernike > until > 0.0 else ""
        source = (
            ", median of mirrors drawn at random; one in ten errs twice as much, other kinds up to 20 times"
            if self.typical
            else ""
        )
        reached = distinct_from(self.max_zernike, until if missed else 0.0)
        right = f"moves then accurate to {reached} (largest coefficient, 95 %{source})"
        return f",{missed} {right}"


@dataclass(frozen=True)
class LawError:
    """Error of moves by the number of maps, as `HysteresisFit.held_out_max_zernike`.

    Attributes:
        first: m, extrapolated to one map from runs of many, by the root of their number.
        own: number of actuators with laws of their own, for which maps can be few; 0 = one law for all.
    """

    first: float
    own: int

    def after(self, maps: int) -> float:
        """m, after `maps` maps."""
        return float(self.first * few_maps(maps, self.own) ** FEWER / np.sqrt(maps))


def forecast(
    plan: Plan,
    settle_time: float,
    earlier: Calibration | None,
    mirror: Mirror,
    map_time: float = 0.0,
    until: float = 0.0,
    guessed: float = 1.0,
    degauss: float = TYPICAL_DEGAUSS_S,
) -> Forecast:
    """Expected duration and accuracy of `plan`; accuracy only of hysteresis plans.

    Args:
        settle_time: s between command and map.
        earlier: calibration of the same mirror, which gives the error of its law; None = there is none.
        map_time: s that the last map took; 0 = none was taken: estimated from `earlier`, else `guessed`.
        until: accuracy at which the run ends, m, if its plan may end early.
        guessed: s per map if nothing else is known.
        degauss: s that a degauss takes.
    """
    if not map_time:
        map_time = guessed
        if earlier is not None and len(earlier.maps) > 1:
            gap = np.diff(np.sort(earlier.maps.stamp_ns)) * 1e-9
            map_time = max(float(np.median(gap)) - settle_time, 0.0)
    measured = np.array([step.takes_map for step in plan.steps], dtype=bool)
    times = np.cumsum(step_times(plan, settle_time, map_time, degauss, TYPICAL_FIT_S))[measured]
    duration = float(times[-1]) if len(times) else 0.0
    expected = Forecast(duration, 0.0)
    tested = any(step.kind is StepKind.CHECK for step in plan.steps)
    typical = earlier is None or earlier.hysteresis is None
    if not tested or (typical and mirror.actuators < 2):  # the typical figure is of mirrors with many actuators
        return expected
    law = law_error(earlier, mirror)
    for part in (*(int(measured[:end].sum()) for end in sorted(plan.ends)), len(times)):
        expected = Forecast(float(times[part - 1]), law.after(part), part, typical)
        if expected.max_zernike <= until:
            break
    return expected


def degauss_time(driver_facts: Mapping[str, Any]) -> float:
    """Expected duration of a degauss of 100 half-swings, s, with a driver of these facts."""
    slew_rate = driver_facts.get("slew_rate_max")
    return DEGAUSS_TRAVEL / slew_rate if slew_rate else TYPICAL_DEGAUSS_S


def step_times(plan: Plan, settle_time: float, map_time: float, degauss: float, fit_time: float) -> Floats:
    """Duration of each step of `plan`, s; a step at which the plan may end begins with a fit.

    Args:
        map_time: s per map beyond the `settle_time`.
        degauss, fit_time: s per degauss, and per fit.
    """
    return np.array(
        [
            (map_time + step.settle_share * settle_time + step.dwell if step.takes_map else degauss)
            + fit_time * (number in plan.ends)
            for number, step in enumerate(plan.steps)
        ]
    )


def law_error(earlier: Calibration | None, mirror: Mirror) -> LawError:
    """How the error falls, by the `earlier` calibration of `mirror`, or as for typical mirrors."""
    if earlier is None or earlier.hysteresis is None:
        return LawError(float(TYPICAL_LAW * np.sqrt(mirror.actuators)), mirror.actuators)
    found, falls = earlier.hysteresis, LawError(1.0, earlier.hysteresis.law.actuators)
    return replace(falls, first=found.held_out_max_zernike / falls.after(found.maps))


def expected_end(plan: Plan, done: int, reached: float, until: float, law: LawError, own: int = 0) -> tuple[int, float]:
    """The number of steps of `plan` after which the error `until` (m) is expected, or all, and the error expected then.

    The error falls suddenly when the law is found, at a time that cannot be predicted; before, the expected error is 0
    (not known). From then on it is inversely proportional to the root of the number of maps, besides the factor for few
    maps, which `reached` includes if it is that of `own` laws.

    Args:
        done: steps so far.
        reached: error after these, m.
        own: number of actuators with laws of their own in the fit that reached it; 0 = one law for all.
    """
    reached /= few_maps(done, own)
    if reached > WORST_LAW * law.first / np.sqrt(done):
        return len(plan.steps), 0.0
    ends = [*(end for end in sorted(plan.ends) if end > done + 1), len(plan.steps)]
    expected = [reached * few_maps(end, own) * np.sqrt(done / end) for end in ends]
    k = next((k for k, value in enumerate(expected) if value <= until), -1)
    return ends[k], float(expected[k])


class GoodEnough:
    """Whether a hysteresis run may end: it is accurate enough, or more maps no longer help.

    Args:
        until: m, as `HysteresisFit.held_out_max_zernike`.
        report: called with what is found after each part of the run.
        limits: of the signals, as for :func:`~dm_calibration.hysteresis.hysteresis_fit.fit_hysteresis`.

    Attributes:
        reached: error after each part, m.
        fit_time: s that the last fit took, at first a typical time.
    """

    def __init__(
        self, until: float, report: Callable[[HysteresisFit], None] = lambda found: None, limits: Limits | None = None
    ) -> None:
        self._until, self._report, self._limits = until, report, limits
        self.reached: list[float] = []
        self.fit_time = TYPICAL_FIT_S

    def __call__(self, outcome: Outcome) -> bool:
        began = time.monotonic()
        try:
            found = fit_hysteresis(outcome.maps(), limits=self._limits)
        except TooFewMapsError:
            return False
        self.fit_time = time.monotonic() - began
        self.reached.append(found.held_out_max_zernike)
        self._report(found)
        return self.reached[-1] <= self._until or self._no_longer_better

    @property
    def _no_longer_better(self) -> bool:
        """Whether the last parts improved on the best of the earlier parts by too little."""
        before, last = self.reached[:-STANDSTILL_PARTS], self.reached[-STANDSTILL_PARTS:]
        return bool(before) and min(last) > (1.0 - STANDSTILL) * min(before)

    def sentence(self, found: float) -> str:
        """A sentence that compares the error `found` (m) at the end of a run with the goal."""
        way = ", ".join(rounded(value * 1e9) for value in self.reached)
        parts = f" (after each part: {way} nm)" if way else ""
        if found <= self._until:
            return f"{in_nanometres(self._until)} is reached: {in_nanometres(found)}{parts}"
        reason = "more maps did not help" if self._no_longer_better else "no more maps were allowed (hysteresis_maps)"
        return f"{in_nanometres(self._until)} is not reached, but {distinct_from(found, self._until)}: {reason}{parts}"
