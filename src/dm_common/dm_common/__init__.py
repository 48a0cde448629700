"""Code shared by several nodes of the suite: executor and parameters, optics, hysteresis model, limits, messages."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
