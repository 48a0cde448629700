"""Parameters of the node `interferometer`, and their conversion to settings of the library."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_topic_name import validate_topic_name

from dm_calibration.acquisition.acquisition import AcquisitionSettings
from dm_calibration.acquisition.ingest import IngestSettings
from dm_calibration.map_files import MapFileError, SurfaceMap, read_map
from dm_calibration.optics.instrument import RETRACE_SIZE
from dm_calibration.optics.orientation import Orientation
from dm_common.ros.parameters import AUTOSTART, Parameter, live, parameters_of
from dm_common.values import from_values, real, switch, text

PARAMETERS = (
    AUTOSTART,
    Parameter(
        "frame_id",
        text(""),
        "Mirror surface frame (x right, y up); empty = mirror, preceded by the namespace if there is one.",
    ),
    Parameter(
        "watch_folder", text("", path=True), "Folder in which the instrument saves its maps; empty = watch nothing."
    ),
    *parameters_of("", AcquisitionSettings),
    Parameter(
        "zernike_topic",
        text(""),
        "Topic of ZernikeCoefficients (any convention) from a sensor such as a Shack-Hartmann, used instead of map "
        "files; empty = none.",
    ),
    live("measure_timeout", real(60.0, 0.1, 86400.0, "s"), "Time limit of a measurement whose request sets none."),
    *parameters_of("orientation.", Orientation),
    Parameter(
        "reference_surface",
        text("", path=True),
        "Map file of the instrument's own error, as the instrument shows it (before orientation.*), to subtract from "
        "every map; empty = none.",
    ),
    live(
        "aperture.centre_x",
        real(0.0, -1.0, 1.0, "m"),
        "Centre of the aperture, x right, from the centre of the oriented map; used with aperture.radius.",
    ),
    live("aperture.centre_y", real(0.0, -1.0, 1.0, "m"), "As aperture.centre_x, y up."),
    *parameters_of("", IngestSettings),
    live("publish_map", switch(True), "Publish the map itself, several megabytes."),
)


def configure(
    values: Mapping[str, Any], resolve: Callable[[str], str] = lambda topic: f"/{topic.strip('/')}"
) -> tuple[AcquisitionSettings, SurfaceMap | None]:
    """Settings of map acquisition, and the reference surface; None = there is none.

    Args:
        resolve: gives the full name of a topic of the node; by default without a namespace.

    Raises:
        ValueError: values that contradict each other, or an unusable reference map.
    """
    topic = values["zernike_topic"]
    others = ("watch_folder", "trigger_command", "reference_surface", "retrace", "distortion")
    if topic and any(values[name] for name in others):
        raise ValueError(f"zernike_topic = {topic!r}: {', '.join(others)} must be empty beside it")
    if len(values["retrace"]) not in (0, RETRACE_SIZE):
        raise ValueError(f"retrace: {len(values['retrace'])} numbers, must be {RETRACE_SIZE} or none")
    for name in ("aperture.follow", "aperture.centre_x", "aperture.centre_y"):
        if values[name] and not values["aperture.radius"]:
            raise ValueError(
                f"{name} = {values[name]}: has an effect only with aperture.radius, which is 0: the aperture is found "
                "in each map"
            )
    try:
        validate_topic_name(topic or "none")
    except InvalidTopicNameException as error:
        raise ValueError(f"zernike_topic = {topic!r}: {error}") from error
    if topic and resolve(topic) == resolve("zernike"):
        raise ValueError(f"zernike_topic = {topic!r}: must not be a topic that this node itself publishes")
    path, unit = values["reference_surface"], values["xyz_unit"]
    expected = values["wavelength.expected"], values["wavelength.tolerance"]
    folder = Path(values["watch_folder"]).expanduser() if values["watch_folder"] else None
    settings = from_values(AcquisitionSettings, values, folder=folder)
    return settings, load_reference(path, unit, *expected) if path else None


def load_reference(path: str, xyz_unit: str, wavelength: float, tolerance: float) -> SurfaceMap:
    """The reference surface in a map file.

    Args:
        wavelength: expected of the instrument, m; 0 = any.

    Raises:
        ValueError: not a readable map, or one of another wavelength.
    """
    try:
        reference = read_map(Path(path).expanduser(), xyz_unit=xyz_unit or None)
    except MapFileError as error:
        raise ValueError(f"reference_surface: {error}") from error
    if wavelength and reference.wavelength and abs(reference.wavelength - wavelength) > tolerance:
        raise ValueError(
            f"reference_surface = {path!r}: wavelength {reference.wavelength * 1e9:.3f} nm, must be "
            f"{wavelength * 1e9:.3f} nm as the instrument's (wavelength.expected)"
        )
    return reference
