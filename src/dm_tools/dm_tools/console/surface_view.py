"""The latest map beside the prediction of the calibration; computed once for all open pages."""

from typing import Any

from dm_common import Floats
from dm_common.messages import stamp_ns
from dm_tools.console.console_node import Snapshot
from dm_tools.console.state_observer import EffectiveSignals, StateObserver
from dm_tools.console.surfaces import Surface, SurfaceModel, difference, measured_surface
from dm_tools.verify import map_of

NO_CALIBRATION = "No calibration is in use: nothing can be predicted."
MOVED = "The mirror has moved since this map; all three show the moment of the map."
CREEP_BEFORE = "Creep of shapes held before the focus controller followed the mirror is not known."
#: Smaller changes of the effective signals do not count as a move: creep, and corrections that hold a shape against it.
SMALL_MOVE = 2e-3
#: The prediction is drawn again when an effective signal has changed by this much, normalised.
DRAWN_AGAIN = 1e-4


class SurfaceView:
    """The surfaces that are shown, and remarks on them.

    Attributes:
        version: rises whenever something changed.
        measured, predicted, difference: surfaces, or the reason why there is none. `predicted` is for now,
            `difference` for the moment of the map.
        predicted_then: surface predicted for the moment of the map; None = not known.
        predicted_zernike: (K,) m predicted for the moment of the map; None = not known.
        remark: on what the prediction leaves out, in words; "" = nothing.
        stamp: ns, of the map; 0 = none.
        when: whether the map is of the present shape, in words.
    """

    def __init__(self, observer: StateObserver) -> None:
        self._observer = observer
        self.version = self.stamp = 0
        self.measured: Surface | str = "No map was measured yet."
        self.predicted: Surface | str = NO_CALIBRATION
        self.difference: Surface | str = NO_CALIBRATION
        self.predicted_then: Surface | None = None
        self.predicted_zernike: Floats | None = None
        self.remark = self.when = ""
        self._model: SurfaceModel | str = NO_CALIBRATION
        self._calibration = self._image = None
        self._then = self._now = EffectiveSignals(None, "")

    @property
    def doubt(self) -> str:
        """Why the prediction is only a guess, in words; "" = it is not."""
        return self._now.doubt

    def update(self, snapshot: Snapshot) -> None:
        """Take new messages and estimates, and compute the surfaces again if they have changed."""
        new = self._take_calibration(snapshot.calibration) | self._take_map(snapshot)
        then = self._observer.at(1e-9 * self.stamp)  # the estimate for the time of the map may arrive after the map
        now = self._observer.now(snapshot.bench_time)
        if new or not (then.near(self._then) and now.near(self._now, DRAWN_AGAIN)):
            self._then, self._now = then, now
            self._draw()
            self.version += 1

    def _take_calibration(self, calibration: Any) -> bool:
        if calibration is self._calibration:
            return False
        self._calibration = calibration
        try:
            self._model = SurfaceModel(calibration) if calibration is not None else NO_CALIBRATION
        except ValueError as error:
            self._model = str(error)
        return True

    def _take_map(self, snapshot: Snapshot) -> bool:
        image, info = snapshot.surface_map, snapshot.surface_map_info
        if image is self._image or info is None or image.header.stamp != info.header.stamp:
            return False
        self._image, self.stamp = image, stamp_ns(info.header.stamp)
        try:
            self.measured = measured_surface(map_of(image), info)
        except ValueError as error:
            self.measured = f"The last map cannot be shown: {error}"
        return True

    def _draw(self) -> None:
        """Compute what is shown."""
        self.predicted_then = self.predicted_zernike = None
        self.when = self.remark = ""
        if isinstance(self._model, str):
            self.predicted = self.difference = self._model
            return
        self.remark = CREEP_BEFORE if self._observer.creep_unseen else ""
        try:
            self.predicted = self._model.surface(_known(self._now, self._model))
        except ValueError as error:
            self.predicted = str(error)
        if isinstance(self.measured, str):
            self.difference = self.measured
            return
        try:
            then = _known(self._then, self._model)
            self.predicted_then, self.predicted_zernike = self._model.surface(then), self._model.coefficients(then)
            self.difference = difference(self.measured, self.predicted_then)
        except ValueError as error:
            self.difference, self.predicted_zernike = f"Not comparable: {error}.", None
        if self.predicted_then is not None and isinstance(self.predicted, Surface):
            moved = not self._now.near(self._then._replace(doubt=self.doubt), SMALL_MOVE)
            self.when = MOVED if moved else "The map is of the present shape."


def _known(signals: EffectiveSignals, model: SurfaceModel) -> Floats:
    """The effective signals (N,). Raises ValueError when they are not known, or of another mirror."""
    if signals.effective is None or signals.effective.shape != (model.actuators,):
        raise ValueError(signals.doubt or "the calibration is of another mirror")
    return signals.effective
