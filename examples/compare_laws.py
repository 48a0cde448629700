"""Which law does a mirror follow? From commands, times and any linear measurement, without ROS. See docs/calibrate.md.

    ./dm exec python examples/compare_laws.py RECORD.npz

RECORD.npz holds `commands` (measurements, actuators) normalised to -1..+1, `times` (measurements,) s, and `measured`
(measurements, numbers): slopes of a wavefront sensor, Zernike coefficients or sag at points.
"""

import sys

import numpy as np

from dm_calibration import identify_response

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
