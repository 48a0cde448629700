"""Parameters of the node `interferometer`, and what they mean to the library."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_topic_name import validate_topic_name

from dm_calibration.acquisition.acquisition import AcquisitionSettings
from dm_calibration.acquisition.ingest import IngestSettings
from dm_calibration.acquisition.reference_surface import load_reference
from dm_calibration.map_files import SurfaceMap
from dm_calibration.optics.instrument import RETRACE_SIZE
from dm_calibration.optics.orientation import Orientation
from dm_common.ros.parameters import AUTOSTART, Parameter, live, parameters_of, real, switch, text, texts
from dm_common.values import from_values

PARAMETERS = (
    AUTOSTART,
    Parameter(
        "frame_id",
        text(""),
        "Mirror surface frame (x right, y up); empty = mirror, behind the namespace where there is one.",
    ),
    Parameter(
        "watch_folder", text("", path=True), "Folder in which the instrument saves its maps; empty = watch nothing."
    ),
    Parameter(
        "file_pattern",
        texts(["*.dat", "*.datx", "*.asc", "*.xyz", "*.fits", "*.h5", "*.4D"]),
        "Names of the files to take from watch_folder, as shell patterns.",
    ),
    Parameter("stable_time", real(0.5, 0.02, 3600.0, "s"), "Time for which size and time of a file must stand still."),
    Parameter(
        "trigger_command",
        texts([]),
        "Command that makes the instrument take a map, as an argument list (no shell); {path} in an argument is "
        "replaced by the file in watch_folder it must write. Empty = measure waits for the next new file.",
    ),
    Parameter(
        "zernike_topic",
        text(""),
        "Topic of ZernikeCoefficients, in any convention, from a sensor such as a Shack-Hartmann, in place of map "
        "files; empty = none.",
    ),
    Parameter("trigger_output_suffix", text(".datx"), "Ending of the file name that replaces {path}."),
    Parameter("trigger_timeout", real(30.0, 0.1, 3600.0, "s"), "Time limit of trigger_command."),
    live("measure_timeout", real(60.0, 0.1, 86400.0, "s"), "Time limit of a measurement that asks for none."),
    live(
        "aperture.radius",
        real(0.0, 0.0, 1.0, "m"),
        "Radius of the aperture; 0 = find the valid region of each map.",
    ),
    live(
        "aperture.centre_x",
        real(0.0, -1.0, 1.0, "m"),
        "Centre of the aperture from the oriented map's centre, x right; used with aperture.radius.",
    ),
    live("aperture.centre_y", real(0.0, -1.0, 1.0, "m"), "The same, y up."),
    live(
        "aperture.follow",
        switch(False),
        "Count that from the centre of the valid region, found anew in each map, where that ends at the rim of the "
        "mirror or of a mask on it.",
    ),
    live(
        "aperture.valid_fraction_min",
        real(0.7, 0.0, 1.0),
        "Least share of valid pixels in the aperture of a map that is published; maps with fewer are refused.",
    ),
    *parameters_of("orientation.", Orientation),
    live(
        "wavelength.expected",
        real(0.0, 0.0, 2e-5, "m"),
        "Wavelength of the instrument; maps of another are refused. 0 = any.",
    ),
    live("wavelength.tolerance", real(1e-9, 0.0, 1e-6, "m"), "Allowed difference from it."),
    live(
        "pitch",
        real(0.0, 0.0, 0.1, "m"),
        "Lateral resolution per pixel, as `./dm measure --reference-sphere METRES` finds it; files that tell one "
        "that differs by more than 5 % are refused. 0 = as the files tell.",
    ),
    Parameter(
        "reference_surface",
        text("", path=True),
        "Map file of the instrument's own error, as it shows it (before orientation.*), which is subtracted from every "
        "map; empty = nothing is.",
    ),
    *parameters_of("", IngestSettings),
    live("publish_map", switch(True), "Publish the map itself, several megabytes."),
)


def configure(values: Mapping[str, Any]) -> tuple[AcquisitionSettings, SurfaceMap | None]:
    """What maps are taken by, and the reference surface; None = there is none.

    Raises:
        ValueError: values that contradict each other, or no map to refer to.
    """
    topic = values["zernike_topic"]
    others = ("watch_folder", "trigger_command", "reference_surface", "retrace", "distortion")
    if topic and any(values[name] for name in others):
        raise ValueError(f"zernike_topic = {topic!r}: {', '.join(others)} must be empty beside it")
    if len(values["retrace"]) not in (0, RETRACE_SIZE):
        raise ValueError(f"retrace: {len(values['retrace'])} numbers, must be {RETRACE_SIZE} or none")
    if topic.strip("/") == "zernike":
        raise ValueError(f"zernike_topic = {topic!r}: is what this node itself publishes")
    try:
        validate_topic_name(topic or "none")
    except InvalidTopicNameException as error:
        raise ValueError(f"zernike_topic = {topic!r}: {error}") from error
    path, unit = values["reference_surface"], values["xyz_unit"]
    expected = values["wavelength.expected"], values["wavelength.tolerance"]
    return acquisition_settings(values), load_reference(path, unit, *expected) if path else None


def ingest_settings(
    values: Mapping[str, Any], mirror_radius: float = 0.0, reference: SurfaceMap | None = None
) -> IngestSettings:
    """What maps are read with, of a mirror of `mirror_radius`, m; 0 = not known."""
    return from_values(
        IngestSettings,
        values,
        wavelength=values["wavelength.expected"],
        wavelength_tolerance=values["wavelength.tolerance"],
        orientation=from_values(Orientation, values, "orientation."),
        aperture_radius=values["aperture.radius"],
        mirror_radius=mirror_radius,
        aperture_centre=(values["aperture.centre_x"], values["aperture.centre_y"]),
        aperture_follow=values["aperture.follow"],
        valid_fraction_min=values["aperture.valid_fraction_min"],
        reference=reference,
    )


def acquisition_settings(values: Mapping[str, Any]) -> AcquisitionSettings:
    """What maps are taken by.

    Raises:
        ValueError: values that contradict each other.
    """
    folder = values["watch_folder"]
    return AcquisitionSettings(
        folder=Path(folder).expanduser() if folder else None,
        patterns=values["file_pattern"],
        stable_time=values["stable_time"],
        trigger_command=list(values["trigger_command"]),
        trigger_suffix=values["trigger_output_suffix"],
        trigger_timeout=values["trigger_timeout"],
    )
