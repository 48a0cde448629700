"""Code shared by several nodes of the suite: executor and parameters, optics, hysteresis model, limits, messages."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: Half-width of a 95 % interval, and 95 % quantile of the largest error of some twenty coefficients that err
#: independently, in standard deviations.
SIGMAS_95, LARGEST_95 = 1.96, 2.5
