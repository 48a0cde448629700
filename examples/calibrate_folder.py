"""Calibrate from a folder of map files and the commands they show, without ROS. See docs/calibrate.md.

    ./dm exec python examples/calibrate_folder.py FOLDER

FOLDER/commands.csv has a row for each map, in the order of the file names, and a column for each actuator.
"""

import sys
from pathlib import Path

import numpy as np

from dm_calibration import calibrate
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.geometry import hexagonal_positions
from dm_common.mirror import Mirror

folder = Path(sys.argv[1])
commands = np.loadtxt(folder / "commands.csv", delimiter=",")  # normalised signals, -1 to +1
x, y = hexagonal_positions(actuators=37, pitch=4.3e-3)  # m
mirror = Mirror("PDM30-37", "1234", x, y, working_radius=11e-3)

calibration = calibrate(folder, commands, mirror=mirror)
print(f"{len(calibration.maps)} maps, {calibration.fit.held_out_rms * 1e9:.2f} nm rms on maps held out")
print("influence function, m per unit signal:", calibration.fit.influence_zernike.shape)
print(*calibration.limitations, sep="\n")
# In a folder of its own, since map files may end in .h5 too. The node loads it once it is in calibration_folder.
print("stored as", CalibrationStore(folder / "calibrations").save(calibration))
