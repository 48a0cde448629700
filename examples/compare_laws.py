"""Which law does a mirror follow? From commands, times and any linear measurement, without ROS. See docs/calibrate.md.

    ./dm exec python examples/compare_laws.py RECORD.npz

RECORD.npz holds `commands` (measurements, actuators) normalised to -1..+1, `times` (measurements,) s, and `measured`
(measurements, numbers): slopes of a wavefront sensor, Zernike coefficients or sag at points.
"""

import sys

import numpy as np
from scipy.optimize import lsq_linear

from dm_calibration import identify_response
from dm_common.hysteresis.inverse import invert

record = np.load(sys.argv[1])
found = identify_response(record["commands"], record["measured"], record["times"])
print(found)
print("influence function, measured numbers per unit of effective signal:", found.influence.shape)
measured = record["measured"]
signal = np.sqrt(np.nanmean(np.nanvar(measured, axis=0)))
drift = np.sqrt(np.mean(found.drift**2))
print(f"drift of the zero over the record: {100 * drift / signal:.2f} % of the signal")
left = np.nanstd(measured - found.predict(record["commands"], record["times"]))
print(f"what the law leaves of the whole record, drift included: {100 * left / signal:.2f} %")

# Signals within -1 to +1 that make a wanted measurement after a degauss at 0: here halfway between the last two shapes.
wanted = found.predict(record["commands"][-2:]).mean(axis=0)
rested = found.law.demagnetised(len(found.influence), 0.0)
low, high = (found.law.position_at(rested, np.full(len(found.influence), end)) for end in (-1.0, 1.0))
effective = lsq_linear(found.influence.T, wanted - found.figure, (low, high)).x
signals = invert(found.law, rested, effective, -1.0, 1.0).signals
reached = found.predict(signals[None])[0]
print(f"closest to the wanted measurement: within {100 * np.std(wanted - reached) / signal:.2f} % of the signal")
