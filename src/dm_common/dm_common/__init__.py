"""What more than one node of the suite needs: executor and parameters, optics, hysteresis model, limits, messages."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
