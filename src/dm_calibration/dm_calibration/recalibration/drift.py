"""What maps that came later have shown of a calibrated mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DriftRates:
    """How fast a mirror is expected to change; standard deviations after one day, growing with the root of time.

    Attributes:
        gain: relative, of each gain; half of the variance is common to all (temperature).
        figure: m rms.
    """

    gain: float = 3e-4
    figure: float = 1e-9


@dataclass(frozen=True, eq=False)
class Drift:
    """What later maps have shown of a mirror. Never changed in place.

    Attributes:
        gain: (N,) relative changes.
        offset: (R,) m rms, change of the figure in reduced values.
        covariance: (N + R, N + R) of both.
        stamp_ns: time it holds for.
        revision: maps taken in.
        checked_ns: stamp of the last of them; 0 = none.
        surprising: maps in a row, the last ones, that disagreed.
        foretold: sum of squares of the changes that were foretold to maps, in standard deviations.
        borne_out: sum of their products with the changes that the maps showed.
        stuck: (N,) effective signals at which actuators stand that do not move any more; NaN = it moves.
    """

    gain: Floats
    offset: Floats
    covariance: Floats
    stamp_ns: int
    stuck: Floats
    revision: int = 0
    checked_ns: int = 0
    surprising: int = 0
    foretold: float = 0.0
    borne_out: float = 0.0

    @property
    def trust(self) -> float:
        """The share of gain and offset that maps not used for them have borne out, 0 to 1."""
        if self.foretold <= 0.0:
            return 0.0
        return float(np.clip((self.borne_out - np.sqrt(self.foretold)) / self.foretold, 0.0, 1.0))

    def standing(self, effective: Floats) -> Floats:
        """Where the actuators stand when `effective` (N,) is asked for."""
        return np.where(np.isnan(self.stuck), effective, self.stuck)

    @property
    def given_up(self) -> str:
        """The actuators that do not move any more and where they stand, as a sentence; "" = all move."""
        indices = np.flatnonzero(np.isfinite(self.stuck))
        places = ", ".join(f"{index + 1} (stands at {self.stuck[index]:+.2f})" for index in indices)
        return f"Goes on without actuator{'s' if indices.size > 1 else ''} {places}" if places else ""

    @property
    def largest_gain(self) -> tuple[float, int]:
        """The largest relative change of a gain as it is used, and the index of its actuator."""
        index = int(np.abs(self.gain).argmax())
        return self.trust * float(self.gain[index]), index

    @property
    def offset_rms(self) -> float:
        """Change of the figure as it is used, m rms."""
        return self.trust * float(np.linalg.norm(self.offset))
