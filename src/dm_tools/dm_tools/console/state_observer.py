"""Effective signals now and at the time of a map, from the driver's reports and the law of the calibration."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dm_common.hysteresis.model import HysteresisModel, HysteresisState
from dm_common.messages import hysteresis_model_from, stamp_ns
from dm_controller.hysteresis_observer import HysteresisObserver, Look, same_model

Floats = NDArray[np.float64]

#: Reports kept for maps that arrive late.
KEPT = 500


class Standing(NamedTuple):
    """The mirror at one moment.

    Attributes:
        effective: (N,); None = not known.
        doubt: why it is a guess only or not known, in words; "" = it is known.
    """

    effective: Floats | None
    doubt: str


class Following:
    """Follows one mirror. May be asked from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watch = HysteresisObserver()
        self._looks: deque[tuple[float, Look]] = deque(maxlen=KEPT)
        self._moved_before: bool | None = None
        #: Why the law of the calibration is not followed, in words; "" = it is.
        self.fault = ""

    @property
    def law(self) -> HysteresisModel:
        """The law that is followed; the linear one when no memory was identified."""
        return self._watch.law

    @property
    def creep_before(self) -> bool:
        """Whether moves before the first report still creep, which not even a degauss makes known."""
        return bool(self._moved_before) and self.law.creep_rate > 0.0

    def use(self, calibration: Any, middle: float) -> None:
        """Follow the law of a dm_msgs/Calibration from now on."""
        try:
            law, self.fault = hysteresis_model_from(calibration.hysteresis), ""
        except ValueError as error:
            law, self.fault = None, str(error)
        with self._lock:
            before = self._watch.law
            self._watch.use(law if law is not None else HysteresisModel.linear(), middle)
            # Maps that update a calibration publish it again with the same law: what was followed still holds.
            if not same_model(self._watch.law, before):
                self._looks.clear()

    def observe(self, message: Any) -> None:
        """Take the driver's next dm_msgs/ActuatorState."""
        with self._lock:
            if self._moved_before is None:
                self._moved_before = message.turns > 0
            self._watch.observe(message)
            time = 1e-9 * stamp_ns(message.header.stamp)
            look = self._watch.look(time)
            if look.state is not None:
                self._looks.append((time, look))

    def state(self) -> HysteresisState | None:
        """The last state; None before the first report."""
        with self._lock:
            return self._looks[-1][1].state if self._looks else None

    def now(self, time: float) -> Standing:
        """The mirror at `time` (s, ROS time), taken as not before the last report."""
        with self._lock:
            last = self._looks[-1] if self._looks else None
        return self._standing(last, time)

    def at(self, time: float) -> Standing:
        """The mirror at `time` (s), which may lie before the last report."""
        with self._lock:
            found = next((entry for entry in reversed(self._looks) if entry[0] <= time), None)
        if found is None:
            return Standing(None, "no report of the driver is as old as this map")
        return self._standing(found, time)

    def _standing(self, entry: tuple[float, Look] | None, time: float) -> Standing:
        if entry is None or entry[1].state is None:
            return Standing(None, "the driver has not reported yet")
        look = entry[1]
        assert look.state is not None
        law = self._watch.law
        try:
            effective = law.effective(law.advance(look.state, time))
        except ValueError:  # the law was replaced a moment ago, by one with another number of operators
            return Standing(None, "the calibration is being replaced")
        return Standing(effective, look.unknown)
