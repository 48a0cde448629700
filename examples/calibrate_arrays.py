"""Calibrate, with hysteresis and creep, from arrays of commands, times and maps, without ROS. See docs/calibrate.md.

./dm exec python examples/calibrate_arrays.py RUN.npz
"""

import sys

import numpy as np

from dm_calibration import calibrate
from dm_calibration.acquisition.ingest import IngestSettings
from dm_calibration.hysteresis.features import follow
from dm_common.hysteresis.creep_record import rested
from dm_common.mirror import Mirror

run = np.load(sys.argv[1])
mirror = Mirror("my mirror", "1", run["x"], run["y"], working_radius=float(run["radius"]))  # m
settings = IngestSettings(pitch=float(run["pitch"]), aperture_radius=mirror.working_radius)  # m per pixel, m

calibration = calibrate(
    run["sag"],  # (maps, height, width) m, NaN = no data; a map may be all NaN
    run["commands"],  # (maps, actuators) normalised signals, from a degauss on
    run["times"],  # (maps,) s
    moved=run.get("moved"),  # (maps,) s, when the mirror took each shape; None = right after the map before
    mirror=mirror,
    settings=settings,
    hysteresis=True,
)
known = calibration.hysteresis
print(f"{known.name}: coefficients right to {known.held_out_max_zernike * 1e9:.2f} nm on moves held out (95 %)")

# What the model says of the run: effective signals, and the Zernike coefficients that follow from them.
maps = calibration.maps
# Demagnetised, with what the actuators had crept to before the run.
start = rested(known.law, mirror.rest, known.law.crept_at, mirror.limits.middle)
times, moved = 1e-9 * maps.stamp_ns, maps.moved_s() + 1e-9 * maps.stamp_ns[0]
effective, _ = follow(known.law, start, maps.applied, times, moved)
predicted = calibration.fit.zernike_offset + effective @ calibration.fit.influence_zernike.T
left = (maps.coefficients - predicted)[:, 3:]  # without piston and tilt
print(f"the run again: {np.sqrt(np.nanmean(left**2)) * 1e9:.2f} nm rms in the coefficients")
