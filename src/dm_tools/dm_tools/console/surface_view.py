"""The latest map beside what the calibration predicts; worked out once for all open pages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common.messages import stamp_ns
from dm_tools.console.console_node import Snapshot
from dm_tools.console.state_observer import EffectiveSignals, StateObserver
from dm_tools.console.surfaces import Surface, SurfaceModel, difference, measured_surface
from dm_tools.verify import map_of

NO_CALIBRATION = "No calibration is in use: nothing can be predicted."
CREEP_BEFORE = "Creep of what was held before the focus controller followed it is not known."
#: Effective signals that differ less do not count as a move: creep, and steps of holding a shape against it.
SMALL_MOVE = 2e-3
#: The prediction is drawn again when an effective signal has changed by this much, normalised.
DRAWN_AGAIN = 1e-4


class SurfaceView:
    """What is shown of the surface.

    Attributes:
        version: rises whenever something changed.
        measured, predicted, difference: None with a reason in `..._reason`. `predicted` is for now, `difference` for
            the moment of the map.
        predicted_then: for the moment of the map; None = not known.
        predicted_zernike: (K,) m for the moment of the map; None = not known.
        doubt: why the prediction is a guess only, in words; "" = it is none.
        remark: on what the prediction leaves out, in words; "" = nothing.
        when: whether the map is of the present shape, in words.
    """

    def __init__(self, state_observer: StateObserver) -> None:
        self._state_observer = state_observer
        self.version = 0
        self.measured: Surface | None = None
        self.predicted: Surface | None = None
        self.difference: Surface | None = None
        self.predicted_then: Surface | None = None
        self.predicted_zernike: NDArray[np.float64] | None = None
        self.no_map_reason = "No map was measured yet."
        self.no_prediction_reason = self.no_difference_reason = NO_CALIBRATION
        self.doubt = self.remark = self.when = ""
        self._model: SurfaceModel | None = None
        self._calibration: Any = None
        self._map: tuple[int, Any] = (0, None)
        self._at_map: EffectiveSignals | None = None
        self._effective: NDArray[np.float64] | None = None

    @property
    def stamp(self) -> int:
        """ns, of the map; 0 = none."""
        return self._map[0]

    def update(self, snapshot: Snapshot) -> None:
        """Take what is new."""
        changed = self._take_calibration(snapshot.calibration)
        changed |= self._take_map(snapshot)
        changed |= self._take_prediction(snapshot)
        if changed:
            self._compare()
            self.version += 1
        when = self._when()
        if when != self.when:
            self.when = when
            self.version += 1

    def _take_calibration(self, calibration: Any) -> bool:
        if calibration is self._calibration:
            return False
        self._calibration, self._model, self._effective = calibration, None, None
        self.no_prediction_reason = NO_CALIBRATION
        if calibration is not None and calibration.id:
            try:
                self._model = SurfaceModel(calibration)
            except ValueError as error:
                self.no_prediction_reason = str(error)
        return True

    def _take_map(self, snapshot: Snapshot) -> bool:
        image, info = snapshot.surface_map, snapshot.surface_map_info
        if image is None or info is None or image.header.stamp != info.header.stamp:
            return False
        stamp, before = stamp_ns(info.header.stamp), self._at_map
        self._at_map = self._state_observer.at(1e-9 * stamp)  # an estimate may come after the map it is older than
        if image is self._map[1]:
            return before is None or not before.same_as(self._at_map)
        self._map = (stamp, image)
        try:
            self.measured, self.no_map_reason = measured_surface(map_of(image), info), ""
        except ValueError as error:
            self.measured, self.no_map_reason = None, f"The last map cannot be shown: {error}"
        return True

    def _take_prediction(self, snapshot: Snapshot) -> bool:
        if self._model is None:
            changed = self.predicted is not None
            self.predicted, self.doubt = None, ""
            return changed
        settled = self._state_observer.now(snapshot.bench_time)
        if settled.effective is None or settled.effective.shape != (self._model.actuators,):
            changed = self.predicted is not None
            self.predicted, self.no_prediction_reason = None, settled.doubt or "the calibration is of another mirror"
            return changed
        before = self._effective
        if (
            before is not None
            and settled.doubt == self.doubt
            and np.abs(before - settled.effective).max() < DRAWN_AGAIN
        ):
            return False
        self._effective, self.doubt = settled.effective, settled.doubt
        self.remark = CREEP_BEFORE if self._state_observer.creep_unseen else ""
        self.predicted = self._model.surface(settled.effective)
        return True

    def _compare(self) -> None:
        self.difference = self.predicted_then = self.predicted_zernike = None
        if self._model is None:
            self.no_difference_reason = self.no_prediction_reason
        elif self.measured is None or self._at_map is None:
            self.no_difference_reason = self.no_map_reason
        elif self._at_map.effective is None or self._at_map.effective.shape != (self._model.actuators,):
            self.no_difference_reason = (
                f"Not comparable: {self._at_map.doubt or 'the calibration is of another mirror'}."
            )
        else:
            try:
                self.predicted_then = self._model.surface(self._at_map.effective)
                self.difference = difference(self.measured, self.predicted_then)
                self.predicted_zernike = self._model.coefficients(self._at_map.effective)
                self.no_difference_reason = ""
            except ValueError as error:
                self.no_difference_reason = f"Not comparable: {error}."

    def _when(self) -> str:
        if self.measured is None:
            return ""
        then, now = self._at_map, self._effective
        if then is None or then.effective is None or now is None or then.effective.shape != now.shape:
            return ""
        if np.abs(then.effective - now).max() > SMALL_MOVE:
            return "The mirror has moved since this map; all three are of the moment of the map."
        return "The map is of the present shape."
