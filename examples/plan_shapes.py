"""Ask a calibrated mirror for curvatures and hold them against creep, without nodes. See docs/calibrate.md.

    ./dm exec python examples/plan_shapes.py CALIBRATION.h5

The mirror must just have been degaussed about mid range, as the run that calibrated it began. What it may have
held since then, for hours, is not known here and widens the bounds; the nodes keep a record of it.
"""

import sys
import time
from pathlib import Path

import numpy as np

from dm_calibration.calibration import CALIBRATED_ERROR_MAX
from dm_calibration.calibration_messages import calibration_message
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.hysteresis.creep_record import rested
from dm_common.limits import Limits
from dm_common.messages import mirror_info_of
from dm_common.mirror import Mirror
from dm_controller.planning.active_calibration import active_calibration
from dm_controller.planning.target import FocusTarget

sent: list[tuple[float, np.ndarray]] = []  # s, and signals (N,)


def send(signals: np.ndarray) -> np.ndarray:
    """Put your electronics in place of this: send signals (N,), and return them as the electronics quantised them."""
    sent.append((time.time(), signals))
    return signals


file = Path(sys.argv[1])
made = CalibrationStore(file.parent).load(file.stem)
limits = Limits(low=-1.0, high=1.0)  # of your mirror; with pairs and neighbour_difference where neighbours limit it
mirror = Mirror(made.mirror_name, made.mirror_serial, made.actuator_x, made.actuator_y, made.aperture_radius, limits)
active = active_calibration(calibration_message(made, None, "", CALIBRATED_ERROR_MAX), mirror_info_of(mirror))
planner, law = active.planner, active.planner.law
low, high = active.reachable_range(FocusTarget(0.0), 20e-9)
print(f"spheres of {low:.3f} to {high:.3f} 1/m are within reach, to 20 nm")

state = rested(law, mirror.rest, time.time(), mirror.limits.middle)
for curvature in np.linspace(0.8 * low, 0.8 * high, 5):
    now = time.time()
    move = planner.plan(FocusTarget(float(curvature)), state, now)
    state = law.move(state, send(move.signals), now)
    print(f"{curvature:+.3f} 1/m: coefficients within {1e9 * move.plan.max_zernike_upper:.2f} nm (95 %, by its maps)")
    for _ in range(3):  # hold it: the sooner after a move, the faster it creeps
        time.sleep(0.1)
        now = time.time()
        state = law.move(state, send(planner.hold(state, now, move.effective, ahead=0.05)), now)
