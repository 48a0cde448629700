"""Parameters of the node `autofocus`."""

from __future__ import annotations

import math
from typing import Final

from dm_autofocus.sharpness import METRICS
from dm_common.ros.parameters import Parameter

PARAMETERS: Final = (
    Parameter(
        "optics.rest_distance",
        float,
        0.0,
        "Object distance in focus while the mirror is flat; 0 = infinity. See docs/camera.md.",
        "m",
        0.0,
        1e6,
    ),
    Parameter(
        "optics.relay_magnification",
        float,
        1.0,
        "Diameter of the beam on the mirror / diameter of the entrance pupil.",
        "",
        0.01,
        100.0,
    ),
    Parameter("optics.incidence", float, 0.0, "Angle of incidence on the mirror.", "rad", 0.0, math.pi / 3),
    Parameter(
        "optics.pupil_offset",
        float,
        0.0,
        "How far the entrance pupil lies behind the point that object distances count from.",
        "m",
        -100.0,
        100.0,
    ),
    Parameter("optics.wavelength", float, 550e-9, "Mean wavelength of the images.", "m", 1e-7, 2e-5),
    Parameter("metric", str, "tenengrad", "Figure of sharpness.", choices=tuple(METRICS), live=True),
    Parameter(
        "region",
        "float[]",
        [0.25, 0.25, 0.5, 0.5],
        "Region of interest: left, top, width, height as shares of the image.",
        low=0.0,
        high=1.0,
        live=True,
    ),
    Parameter("images_per_step", int, 1, "Images whose median sharpness counts at each position.", low=1, high=100),
    Parameter("image_timeout", float, 2.0, "Longest wait for an image that counts.", "s", 0.01, 600.0),
    Parameter("move_timeout", float, 5.0, "Longest wait for a move to end.", "s", 0.01, 600.0),
    Parameter("settle_time", float, 0.01, "Wait after the last write before images count.", "s", 0.0, 60.0),
    Parameter(
        "stamp_lead",
        float,
        0.0,
        "By how much an exposure begins before its image's stamp; 0 = stamps mark the beginning.",
        "s",
        -1.0,
        10.0,
    ),
    Parameter("monitor_rate", float, 5.0, "Rate of autofocus_state while idle; 0 = none.", "Hz", 0.0, 100.0),
    Parameter(
        "search.coarse_step",
        float,
        8.0,
        "Step of the first sweep over the range, in units of the finest step.",
        "",
        1.0,
        1000.0,
    ),
    Parameter("search.fine_points", int, 7, "Positions of each later sweep.", low=5, high=1000),
    Parameter(
        "search.tolerance",
        float,
        0.0,
        "Finest step of curvature; 0 = the depth of focus of the calibrated aperture (a quarter wave at its edge).",
        "1/m",
        0.0,
        1.0,
    ),
    Parameter(
        "search.approach",
        float,
        1.0,
        "Every sweep begins this far below its first position, but not below the range. The whole range puts all "
        "sweeps on one branch of the hysteresis, less is quicker.",
        "1/m",
        0.0,
        1.0,
    ),
    Parameter(
        "search.least_contrast",
        float,
        0.05,
        "Relative change of sharpness over the range below which there is nothing to focus on.",
        "",
        0.0,
        0.99,
    ),
    Parameter(
        "track.dither",
        float,
        0.5,
        "Tracking: trials this far below and above the focus, in units of the finest step; 0 = stand still and watch.",
        "",
        0.0,
        10.0,
    ),
    Parameter(
        "track.drop", float, 0.3, "Tracking: relative loss of sharpness that starts a new search.", "", 0.01, 0.99
    ),
    Parameter("track.patience", int, 3, "Tracking: images in a row that must have lost it.", low=1, high=1000),
)
