"""The calibration in use: whether it belongs to the mirror at hand, and what moves are planned with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from dm_msgs.msg import Calibration, MirrorInfo
from dm_msgs.msg import RecipeBook as RecipeBookMsg

from dm_common import Floats
from dm_common.errors import NO_CALIBRATION, ErrorCode, Refusal, size_text
from dm_common.hysteresis.model import HysteresisState
from dm_common.limits import Limits
from dm_common.messages import hysteresis_model_from, mirror_from, recipe_book_from, stamp_ns, taken
from dm_common.mirror import APERTURE_TOLERANCE, mismatch
from dm_common.optics.zernike import PISTON_TILT
from dm_common.recipes import NO_RECIPES, RecipeBook
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.planning.planner import HysteresisFigures, Planner
from dm_controller.planning.recipes import Corrections, target_of
from dm_controller.planning.target import FocusTarget

NO_DRIVER = "no mirror_info from pdm_driver yet"
#: Addition to the refusal while no calibration has been heard of, as in the first moments of the node.
NOT_YET = "if one is in use, it arrives within seconds of this node's start"
#: Warning where `hold_tilt` is true but the tilt cannot be held.
NO_TILT = (
    "its maps do not show the actuators' tilt (was it removed from them?): hold_tilt = true cannot hold it, and a "
    "camera's picture moves with the focus; calibrate from maps that keep their tilt, or set hold_tilt = false"
)
#: Largest relative difference between the spans of effective signals and of signals in a full cycle; more is an error.
SPAN_TOLERANCE = 0.5


@dataclass(frozen=True, eq=False)
class ActiveCalibration:
    """A mirror that can be focused.

    Attributes:
        calibration: as received.
        mirror: its influence function inside the limits.
        worst_case: the same inside limits that the effective signals can reach from any history.
        planner: of its moves.
        recipes: may be empty.
    """

    calibration: Calibration
    mirror: CalibratedMirror
    worst_case: CalibratedMirror
    planner: Planner
    recipes: RecipeBook

    @property
    def middle(self) -> float:
        """Signal of mid range, where a degauss ends."""
        return self.mirror.limits.middle

    def reachable_range(self, target: FocusTarget, tolerance: float) -> tuple[float, float]:
        """See :meth:`CalibratedMirror.reachable_range`; only what can be reached from any history."""
        return self.worst_case.reachable_range(target, tolerance)

    def degauss_steps(self, configured: int) -> int:
        """Half-swings of the conditioning degauss: `configured`, else as for the recipes; 0 = the driver's own."""
        return configured or (self.recipes.degauss_steps if self.recipes.recipes else 0)

    @cached_property
    def corrections(self) -> Corrections:
        """The corrections that the recipes give for other shapes. Raises RecipeError when there are none."""
        return Corrections(self.recipes, self.planner, stamp_ns(self.calibration.checked))

    @property
    def conditioned_error(self) -> float:
        """m, bound of the largest coefficient error of a conditioned move; 0 = no recipes."""
        return self.corrections.worst if self.recipes.recipes else 0.0

    def note_creep_shown(self, before: "ActiveCalibration | None", state: HysteresisState | None) -> None:
        """Let bounds leave out the creep until the last check, as far as this calibration includes it from maps.

        Args:
            before: the calibration used until now; a check that it does not include was made at `state`.
        """
        planner, last = self.planner, self.calibration.checked
        if (
            before is None
            or before.calibration.id != self.calibration.id
            or not before.planner.law.same_as(planner.law)
        ):
            return
        if before.calibration.checked == last:
            planner.creep_shown = before.planner.creep_shown
        elif state is not None:
            state = planner.law.advance(state, max(state.time, 1e-9 * stamp_ns(last)))
            shown = before.planner.creep_shown
            moved = self.mirror.model.zernike_offset - before.mirror.model.zernike_offset
            change = float(np.abs(moved[PISTON_TILT:]).max())  # beyond that of earlier checks, or the error of one map
            change += planner.error_bound(known=True) if shown is None else shown.change
            planner.note_creep_shown(state, self.calibration.creep_shown, change)

    def stale(self, now_ns: int, age_max_s: float) -> str:
        """The reason why the calibration should be renewed; "" = it is fresh, or of unknown age."""
        seen = stamp_ns(self.calibration.checked) or stamp_ns(self.calibration.header.stamp)
        age = 1e-9 * (now_ns - seen)
        if not age_max_s or not seen or age <= age_max_s:
            return ""
        return (
            f"calibration {self.calibration.id} is stale: no map has agreed with it for {age / 86400.0:.1f} days "
            f"(calibration_age_max {age_max_s / 86400.0:g}); check it with a map or calibrate anew"
        )


def active_calibration(
    calibration: Calibration | None,
    mirror: MirrorInfo | None,
    hold_tilt: bool = True,
    axis: Sequence[float] = (0.0, 0.0),
    recipes: RecipeBookMsg | None = None,
) -> ActiveCalibration:
    """What to plan moves of `mirror` with; `hold_tilt` and `axis`: see `CalibratedMirror`.

    `recipes` of another calibration are ignored.

    Raises:
        Refusal: there is no calibration, it is of another mirror, or its numbers make no sense, naming the field.
    """
    if calibration is None or not calibration.id:
        text = NO_CALIBRATION if calibration is not None else f"{NO_CALIBRATION}; {NOT_YET}"
        raise Refusal(ErrorCode.NOT_CALIBRATED, text if mirror is not None else f"{text}; {NO_DRIVER}: is it running?")
    if mirror is None:
        raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, f"the mirror's limits are unknown: {NO_DRIVER}")
    try:
        described = mirror_from(mirror)
        wrong = mismatch(
            described,
            calibration.mirror_serial,
            calibration.actuators,
            calibration.aperture_radius,
            calibration.aperture_tolerance or APERTURE_TOLERANCE,
        )
        if wrong:
            raise Refusal(ErrorCode.CALIBRATION_MISMATCH, f"calibration {calibration.id}: {wrong}")
        slew_rate = mirror.slew_rate_max if mirror.slew_rate_max > 0.0 else math.inf
        limits, model = described.limits, model_of(calibration, described.x, described.y)
        calibrated = CalibratedMirror(model, limits, hold_tilt, axis)
        own = recipes is not None and recipes.calibration_id == calibration.id
        book = recipe_book_from(recipes) if own else NO_RECIPES
        if any(len(recipe.effective) != calibration.actuators for recipe in book.recipes):
            raise ValueError(f"recipes: effective must have {calibration.actuators} values each")
        for recipe in book.recipes:
            target_of(recipe, model.aperture_radius)
        planner = Planner(calibrated, hysteresis_figures_of(calibration, limits), slew_rate)
        worst_case = calibrated
        if not planner.law.is_identity:
            from dm_common.hysteresis.law_shape import worst_case_limits  # not imported at the start

            worst_case = CalibratedMirror(model, worst_case_limits(planner.law, limits), hold_tilt, axis)
    except ValueError as error:
        raise Refusal(ErrorCode.CALIBRATION_UNREADABLE, f"calibration {calibration.id}: {error}") from error
    return ActiveCalibration(calibration, calibrated, worst_case, planner, book)


def model_of(calibration: Any, actuator_x: Floats | None = None, actuator_y: Floats | None = None) -> InfluenceModel:
    """The influence model of a dm_msgs/Calibration of a mirror with actuators at these positions, (N,) m.

    Raises ValueError when its arrays do not fit together.
    """
    from dm_common.optics.sampling import SamplePoints  # not imported at the start

    actuators = calibration.actuators

    def matrix(name: str, rows: int) -> Floats:
        values = np.asarray(getattr(calibration, name), dtype=float)
        if values.size != rows * actuators:
            raise ValueError(f"calibration: {size_text(name, values.size)}: must be {rows} x {actuators}")
        return values.reshape(rows, actuators)

    names = ("sample_x", "sample_y", "sample_weight", "zernike_offset", "sag_offset")
    *points, zernike_offset, sag_offset = (np.asarray(getattr(calibration, name), dtype=float) for name in names)
    return InfluenceModel(
        **taken(calibration, "aperture_radius", "held_out_rms", "held_out_max_zernike"),
        points=SamplePoints(*points),
        zernike_offset=zernike_offset,
        sag_offset=sag_offset,
        influence_zernike=matrix("influence_zernike", len(calibration.zernike_offset)),
        influence_sag=matrix("influence_sag", len(calibration.sag_offset)),
        actuator_x=actuator_x,
        actuator_y=actuator_y,
    )


def hysteresis_figures_of(calibration: Any, limits: Limits) -> HysteresisFigures | None:
    """The hysteresis model of a dm_msgs/Calibration for signals inside `limits`; None when none was identified.

    Raises:
        ValueError: a field that makes no sense, or a law that has no inverse, naming it.
    """
    hysteresis = calibration.hysteresis
    try:
        law = hysteresis_model_from(hysteresis)
    except ValueError as error:
        raise ValueError(f"hysteresis: {str(error).removeprefix('hysteresis: ')}") from error
    if law is None:
        return None
    from dm_common.hysteresis.law_shape import slope_min, span  # not imported at the start

    slope = slope_min(law, limits.low, limits.high).min()
    if not slope > 0.0:
        raise ValueError(
            f"hysteresis: play_weight: effective signals fall somewhere as the signal rises (slope {slope:.3g}): must "
            "rise"
        )
    if law.actuators not in (0, calibration.actuators):
        raise ValueError(
            f"hysteresis: play_weight: laws of {law.actuators} actuators, must be of {calibration.actuators} or one"
        )
    spans = span(law, limits.low, limits.high) / (limits.high - limits.low)
    furthest = spans[np.abs(spans - 1.0).argmax()]
    if not abs(furthest - 1.0) <= SPAN_TOLERANCE:
        raise ValueError(
            f"hysteresis: play_weight: effective signals span {furthest:.3g} times the range of the signals: must be "
            f"1 +- {SPAN_TOLERANCE:g}; the law has another scale"
        )
    for name in ("held_out_max_zernike", "unknown_sigma"):
        value = getattr(hysteresis, name)
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"hysteresis: {name} = {value:g}: must be finite and not negative")
    return HysteresisFigures(law, hysteresis.held_out_max_zernike, hysteresis.unknown_sigma)
