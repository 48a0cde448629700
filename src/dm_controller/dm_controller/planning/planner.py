"""From a target and the state of the actuators to a command, with its expected result.

The influence function acts on effective signals. The bounded programme finds those of the target; the inverse of the
hysteresis model finds the signals that produce them from the present state. Holding a shape is the same inversion a
little later, since creep has changed the effect of the same signals.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from dm_msgs.msg import FocusRequest

from dm_common import SIGMAS_95, Floats
from dm_common.hysteresis.creep_record import rested
from dm_common.hysteresis.inverse import ConstrainedInverse, invert, within
from dm_common.hysteresis.model import HysteresisModel, HysteresisState, request_error
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.fast_path import ClosedForm, PreparedInverse
from dm_controller.planning.mirror_model import CalibratedMirror, Plan, rms_bounds
from dm_controller.planning.target import FocusTarget

if TYPE_CHECKING:
    from dm_controller.planning.creep_error import CreepBound, CreepError, CreepShown
    from dm_controller.planning.recipes import FoundRecipe

#: Time at which a shape is to be right unless configured otherwise, s after the end of the move.
SETTLE_S = 0.05
#: Draws for the 95 % quantile of the largest of many errors.
DRAWS = 4000
#: Largest coefficient error of a sphere that counts as within the range of the mirror, m.
RANGE_TOLERANCE = 20e-9
#: Error of an effective signal, normalised, above which a limit counts as binding.
RESIDUAL_MAX = 1e-6
#: Factor by which the bound of creep must exceed that of all other errors for creep to be named as its main source.
MUCH = 2.0


@dataclass(frozen=True, eq=False)
class HysteresisFigures:
    """What a calibration says of its hysteresis model; fields as in dm_msgs/ActuatorHysteresis."""

    law: HysteresisModel
    held_out_max_zernike: float
    unknown_sigma: float


@dataclass(frozen=True, eq=False)
class Move:
    """A planned move.

    Attributes:
        target: the wanted surface.
        signals: (N,) what the electronics get.
        effective: (N,) effective signals aimed at, which holding the shape keeps.
        max_zernike: m, expected largest coefficient error.
        known: whether the state that it begins from can be trusted.
        duration: s until the shape is right.
        mode: FocusRequest.MODE_DIRECT or MODE_CONDITIONED.
        degauss: half-swings of the degauss to begin with, 0 = as the driver does; None = go at once.
    """

    target: FocusTarget
    signals: Floats
    effective: Floats
    max_zernike: float
    known: bool
    duration: float
    _predict: Callable[[], Plan]
    _drift: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)
    mode: str = FocusRequest.MODE_DIRECT
    degauss: int | None = None

    @cached_property
    def plan(self) -> Plan:
        """Command and prediction, computed when first asked for: a command need not wait for it."""
        return self._predict()

    @cached_property
    def drift(self) -> tuple[float, float]:
        """m, what creep adds to the largest coefficient error and to the rms within 1000 s if nothing corrects it."""
        return self._drift()


class Planner:
    """Plans moves of one calibrated mirror.

    Args:
        mirror: its influence function acts on effective signals.
        hysteresis: None = not identified: effective signals are signals.
        slew_rate: of the signals, 1/s; infinite = moves take no time.
    """

    def __init__(
        self, mirror: CalibratedMirror, hysteresis: HysteresisFigures | None = None, slew_rate: float = math.inf
    ) -> None:
        self.mirror, self.hysteresis, self.slew_rate = mirror, hysteresis, slew_rate
        self.law = hysteresis.law if hysteresis is not None else HysteresisModel.linear()
        self._zernike = np.ascontiguousarray(mirror.model.influence_zernike[PISTON_TILT:])
        self._closed_form = ClosedForm(mirror)
        self._prepared: PreparedInverse | None = None
        self._limits = within(mirror.limits) if hysteresis is not None else mirror.limits
        #: Creep that check maps have shown and that the figure includes.
        self.creep_shown: CreepShown | None = None

    @cached_property
    def _constrained(self) -> ConstrainedInverse:
        return ConstrainedInverse(self.law, self._limits, self.mirror.matrix, self.mirror.ridge)

    def prepare(self, state: HysteresisState) -> None:
        """Compute in advance what plans from exactly this `state`, of a mirror at rest, will need."""
        ready = self._prepared
        if self.hysteresis is not None and self.law.has_history and (ready is None or ready.state is not state):
            self._prepared = PreparedInverse(self.law, state, self._limits)

    def plan(
        self,
        target: FocusTarget,
        state: HysteresisState | None,
        time: float,
        known: bool = True,
        recipe: FoundRecipe | None = None,
        ahead: float = 0.0,
    ) -> Move:
        """The move to `target` that begins at `time` (s) from `state`.

        Args:
            state: None = entirely unknown; the mirror is then taken to be degaussed, after shapes held unobserved.
            known: whether the state can be trusted; if not, the bounds are widened.
            recipe: effective signals to aim at instead of the model's own.
            ahead: s after the end of the move at which the shape is to be right; creep is quickest just after a move.

        Raises:
            TargetError: no such surface exists over the aperture.
        """
        mirror, law = self.mirror, self.law
        cut, own, error, measured = False, None, None, None
        if recipe is None:
            found = self._closed_form.find(target)
            aim, largest = found or mirror.command(target)
            # The limits are those of signals, not of effective ones: from this state more or less may be in reach.
            cut = found is None and bool(mirror.limits.at_limit(aim).any())
        else:
            # A recipe corrects an error of the model, so the expected error is only what the limits leave with the
            # model's own signals, plus what they deny of the recipe's signals.
            aim, (own, largest) = recipe.effective, mirror.command(target)
            if math.isfinite(recipe.error):
                error, measured, largest = recipe.error, recipe.built, min(largest, recipe.error)
        if state is None:
            middle, known, travel = mirror.limits.middle, False, 0.0
            state = rested(law, np.full(len(aim), middle), time, middle)
        else:
            travel = float(np.maximum.reduce(np.abs(aim - state.signals))) / self.slew_rate
        begun, arrival = state, time + travel  # older creep goes on during the move
        signals, residual = aim, None
        if self.hysteresis is not None or recipe is not None:
            signals, residual = self._inverted(begun, arrival, aim, ahead, target if recipe is None else None, cut)
        reached = aim
        if residual is not None and np.abs(residual).max() > RESIDUAL_MAX:
            if recipe is None:
                reached = aim - residual
                largest = mirror.predict(target, reached).max_zernike
            else:
                denied, own = self._largest(residual), None if own is None else own - residual
                largest, error = largest + denied, None if error is None else error + denied

        def predict() -> Plan:
            plan = mirror.predict(target, reached if own is None else own)
            if error is not None:
                plan = replace(plan, max_zernike=largest)
            creep = None
            if law.creep_rate:
                at = law.advance(begun, arrival)
                creep = self._creep_error.bound(at, law.position_at(at, signals), ahead, measured)
            return self._bounded(plan, signals, known, creep, error)

        def drift() -> tuple[float, float]:
            if not law.creep_rate:
                return 0.0, 0.0
            at_arrival = law.move(law.advance(begun, arrival), signals, arrival)
            return self._creep_error.drift(at_arrival, aim if residual is None else aim - residual)

        return Move(target, signals, reached, largest, known, travel + ahead, predict, drift)

    def _inverted(
        self,
        state: HysteresisState,
        arrival: float,
        aim: Floats,
        ahead: float,
        target: FocusTarget | None,
        cut: bool = False,
    ) -> tuple[Floats, Floats | None]:
        """Signals (N,) for the effective signals `aim`, and (N,) the part of `aim` that limits deny; None = nothing.

        Where the limits bind, or have `cut` the aim, the signals are those nearest to `target`, or without one to the
        shape of `aim`.
        """
        limits, ready = self._limits, self._prepared
        if ready is not None and ready.state is state and not cut:
            found = ready.invert(arrival, aim, ahead)
            if found is not None:
                return found, None
        at = self.law.advance(state, arrival)
        inverted = invert(self.law, at, aim, limits.low, limits.high, ahead)
        if not cut and np.abs(inverted.residual).max() <= RESIDUAL_MAX and limits.allow_neighbours(inverted.signals):
            return inverted.signals, None
        wanted = self.mirror.matrix @ aim if target is None else self.mirror.rows(*self.mirror.wanted(target))
        signals, reached = self._constrained.solve(at, wanted, ahead, inverted.signals)
        return signals, aim - reached

    def hold(self, state: HysteresisState, time: float, effective: Floats, ahead: float = 0.0) -> Floats:
        """(N,) signals, applied at `time` (s), that keep `effective` (N,) and are right `ahead` s later."""
        return self._inverted(state, time, effective, ahead, None)[0]

    def drift(self, state: HysteresisState, time: float, effective: Floats) -> float:
        """Largest coefficient error (m) at `time` (s) of a mirror that should be at `effective` (N,)."""
        return self._largest(self.law.effective(self.law.advance(state, time)) - effective)

    def _largest(self, effective: Floats) -> float:
        """Largest coefficient beyond tilt, m, of effective signals (N,)."""
        return float(np.abs(self._zernike @ effective).max())

    def note_creep_shown(self, state: HysteresisState, share: float, change: float = math.inf) -> None:
        """Count creep until the time of `state` as in the figure, see `CreepShown`; call it before any plan."""
        from dm_controller.planning.creep_error import CreepShown  # a command does not wait for it

        self.creep_shown = CreepShown(state.time, state.crept, state.crept_sigma, share, change)

    @cached_property
    def _whole(self) -> Floats:
        """(N,) effective signals of the strongest sphere within reach, of the sign that reaches further."""
        sphere = FocusTarget(0.0)
        ends = self.mirror.reachable_range(sphere, RANGE_TOLERANCE)
        far = max((end for end in ends if math.isfinite(end)), key=abs, default=0.0)
        return self.mirror.command(sphere.with_curvature(far))[0]

    @cached_property
    def _creep_error(self) -> CreepError:
        from dm_controller.planning.creep_error import CreepError  # a command does not wait for it

        return CreepError(self.law, self._zernike, self.mirror.sag_root, self._whole, self.creep_shown)

    def error_bound(self, known: bool, error: float | None = None) -> float:
        """m, 95 % bound of the largest coefficient error without creep, with the history `known` or not.

        Args:
            error: the bound for this shape with a known history, m; None = that for any shape.
        """
        if error is None:
            error = request_error(self.mirror.model, self.hysteresis)
        return math.hypot(error, 0.0 if known else self._unknown_history[0])

    def _bounded(self, plan: Plan, signals: Floats, known: bool, creep: CreepBound | None, error: float | None) -> Plan:
        crept, crept_rms = (creep.max_zernike, creep.rms) if creep is not None else (0.0, 0.0)
        rms_spread = math.hypot(
            self.mirror.model.held_out_rms, 0.0 if known else self._unknown_history[1], crept_rms / SIGMAS_95
        )
        largest_spread = self.error_bound(known, None if error is None else error - plan.max_zernike)
        most = ""
        if creep is not None and crept > MUCH * largest_spread:
            held = "of shapes held before this node followed the mirror, which fades over hours"
            most = f"creep {held if creep.unseen else 'that the calibration leaves open'}"
        rms_lower, rms_upper = rms_bounds(plan.rms, rms_spread)
        return replace(
            plan,
            signals=signals,
            rms_lower=rms_lower,
            rms_upper=rms_upper,
            max_zernike_upper=plan.max_zernike + math.hypot(largest_spread, crept),
            saturated=self._limits.at_limit(signals),
            most=most,
        )

    @cached_property
    def _unknown_history(self) -> tuple[float, float]:
        """95 % bound of the largest coefficient error, and rms sag error, when the history is not known; m.

        The larger of two cases: each actuator errs independently, or all together, as a focus moves them.
        """
        if self.hysteresis is None:
            return 0.0, 0.0
        model, sigma = self.mirror.model, self.hysteresis.unknown_sigma
        miss = sigma * np.random.default_rng(0).standard_normal((DRAWS, model.influence_zernike.shape[1]))
        largest = np.abs(miss @ model.influence_zernike[PISTON_TILT:].T).max(axis=1)
        area = model.points.weight[:, None] * np.square(model.influence_sag)
        rms = sigma * np.linalg.norm(self.mirror.sag_root @ self._whole)
        together = SIGMAS_95 * sigma * self._largest(self._whole), rms
        apart = np.quantile(largest, 0.95), sigma * np.sqrt(area.sum())
        return float(max(apart[0], together[0])), float(max(apart[1], together[1]))
