"""From the instrument's view of a map to the mirror surface frame (x right, y up, row 0 = top)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROTATIONS = (0, 90, 180, 270)


@dataclass(frozen=True)
class Orientation:
    """How the instrument's picture must be turned: first the flips, then the rotation.

    Attributes:
        flip_x: exchange left and right.
        flip_y: exchange top and bottom.
        rotate_deg: counter-clockwise, 0, 90, 180 or 270 degrees.
    """

    flip_x: bool = False
    flip_y: bool = False
    rotate_deg: int = 0

    def __post_init__(self) -> None:
        if self.rotate_deg not in ROTATIONS:
            raise ValueError(f"rotate_deg = {self.rotate_deg}: must be one of {', '.join(map(str, ROTATIONS))}")

    def apply(self, sag: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the map in the mirror frame, C-contiguous; (height, width) are exchanged for 90 and 270 degrees."""
        if self.flip_x:
            sag = sag[:, ::-1]
        if self.flip_y:
            sag = sag[::-1]
        return np.ascontiguousarray(np.rot90(sag, self.rotate_deg // 90))
