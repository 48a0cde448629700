"""Parameters of the node `autofocus`, and the settings made from their values."""

import math
from collections.abc import Mapping
from typing import Any, Final

from dm_autofocus.optics import FocusOptics, depth_of_focus
from dm_autofocus.search.defocus_model import FocusLens
from dm_autofocus.search.peak_search import NOISE_POINTS, SearchConfig
from dm_autofocus.search.tracking import TrackConfig
from dm_autofocus.sharpness import METRICS, WHOLE, check_region
from dm_common.ros.parameters import AUTOSTART, Parameter, parameters_of
from dm_common.values import from_values, real, reals, switch, text, whole

PARAMETERS: Final = (
    AUTOSTART,
    Parameter(
        "optics.rest_distance",
        real(0.0, 0.0, 1e6, "m"),
        "Object distance in focus while the mirror is flat; 0 = infinity. See docs/camera.md.",
    ),
    *parameters_of("optics.", FocusOptics),
    Parameter("optics.wavelength", real(550e-9, 1e-7, 2e-5, "m"), "Mean wavelength of the images."),
    Parameter(
        "optics.focal_length_px",
        real(0.0, 0.0, 1e7, "px"),
        "Focal length of the camera / its pixel pitch; 0 = fx of camera_info. If known, a search takes few images.",
    ),
    Parameter("metric", text("tenengrad", choices=tuple(METRICS)), "Measure of sharpness.", live=True),
    Parameter(
        "region",
        reals([0.25, 0.25, 0.5, 0.5], 0.0, 1.0),
        "Region of interest: left, top, width, height as shares of the image.",
        live=True,
    ),
    Parameter(
        "image_transport",
        text("raw", choices=("raw", "compressed")),
        "raw: images come on image_raw; compressed: as JPEG, PNG or TIFF on image_raw/compressed.",
    ),
    Parameter("images_per_step", whole(1, 1, 100), "Images per position; their median sharpness counts."),
    Parameter("image_timeout", real(2.0, 0.01, 600.0, "s"), "Longest wait for an image that counts."),
    Parameter("move_timeout", real(5.0, 0.01, 600.0, "s"), "Longest wait for a move to end."),
    Parameter("settle_time", real(0.01, 0.0, 60.0, "s"), "Wait after the last write before images count."),
    Parameter(
        "stamp_lead",
        real(0.0, -1.0, 10.0, "s"),
        "Time from the start of an exposure to its image's stamp; 0 = the stamp marks the start.",
    ),
    Parameter("monitor_rate", real(5.0, 0.0, 100.0, "Hz"), "Rate of autofocus_state while idle; 0 = none."),
    Parameter(
        "search.coarse_step",
        real(8.0, 1.0, 1000.0),
        "Step of the first sweep over the range, in units of the finest step.",
    ),
    Parameter(
        "search.tolerance",
        real(0.0, 0.0, 1.0, "1/m"),
        "Finest step of curvature, 1/4000 to 1/2 of the range that is searched; 0 = the depth of focus of the "
        "calibrated aperture (a quarter wave at its edge).",
    ),
    *parameters_of("search.", SearchConfig),
    Parameter(
        "search.few_images",
        switch(True),
        "Find the focus from the blur of a few images, if the optics are known; false = always sweep the range.",
    ),
    *parameters_of("track.", TrackConfig),
    Parameter(
        "stack.step",
        real(4.0, 0.5, 1000.0),
        "Focus stack: step between its images, in units of the finest step.",
        live=True,
    ),
    Parameter(
        "stack.cell",
        whole(4, 2, 256, "px"),
        "Focus stack: side of the cells, each with one distance; their sharpness is a mean over 3 x 3 cells.",
        live=True,
    ),
)


def check_changes(changes: Mapping[str, Any]) -> None:
    """Raise ValueError for a region that does not lie in the image."""
    check_region(changes.get("region", WHOLE))


def focus_optics(values: Mapping[str, Any]) -> FocusOptics:
    """The optics of the camera. Raises ValueError for inconsistent optics, or a region outside the image."""
    check_region(values["region"])
    others = {name: values[f"optics.{name}"] for name in ("relay_magnification", "incidence", "pupil_offset")}
    return FocusOptics.from_rest_distance(values["optics.rest_distance"], **others)


#: Fewest and most of the finest steps in a range: time and memory of a search grow with their number.
STEPS_MIN, STEPS_MAX = 2, 4000


def tolerance_of(values: Mapping[str, Any], aperture_radius: float) -> float:
    """Finest step of curvature [1/m]: as configured, else the depth of focus of the calibrated aperture."""
    return float(values["search.tolerance"]) or depth_of_focus(aperture_radius, values["optics.wavelength"])


def search_config(values: Mapping[str, Any], aperture_radius: float, low: float, high: float) -> SearchConfig:
    """The search of a range of curvatures [1/m].

    Raises:
        ValueError: the aperture has no radius, or `search.tolerance` does not suit the range.
    """
    tolerance, span = tolerance_of(values, aperture_radius), high - low
    if values["search.tolerance"] and not span / STEPS_MAX <= tolerance <= span / STEPS_MIN:
        raise ValueError(
            f"search.tolerance = {tolerance:g} 1/m: must be {span / STEPS_MAX:.2g} to {span / STEPS_MIN:.2g} for a "
            f"range of {low:+.4f} to {high:+.4f} 1/m, or 0 (the depth of focus)"
        )
    points = max(NOISE_POINTS, 1 + math.ceil(span / (values["search.coarse_step"] * tolerance)))
    return from_values(SearchConfig, values, "search.", low=low, high=high, tolerance=tolerance, coarse_points=points)


def given_focal_length(values: Mapping[str, Any], camera_info: Any) -> float:
    """Focal length [px] by the parameter, else by a sensor_msgs/CameraInfo (None = none came yet); 0 = not known."""
    focal_length = values["optics.focal_length_px"]
    if focal_length == 0 and camera_info is not None:
        focal_length = camera_info.k[0] / max(camera_info.binning_x, 1)
    return float(focal_length)


def focus_lens(values: Mapping[str, Any], aperture_radius: float, camera_info: Any) -> FocusLens:
    """How defocus looks in the camera; `aperture_radius` [m] of the beam on the mirror, `camera_info` as above.

    Raises ValueError if the focal length is not known.
    """
    focal_length = given_focal_length(values, camera_info)
    if not 0.0 < focal_length < math.inf:
        reason = "came not yet" if camera_info is None else "holds no finite fx"
        raise ValueError(f"optics.focal_length_px is 0, and camera_info {reason}")
    # Behind a relay that widens the beam m times, angles are m times smaller.
    return FocusLens(aperture_radius, values["optics.wavelength"], focal_length * values["optics.relay_magnification"])
