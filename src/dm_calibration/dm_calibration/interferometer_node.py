"""Node `interferometer`: reads map files on request, from a watched folder and after a trigger command; publishes map,
map info, Zernike coefficients and samples.

Stamps are the time of the measurement in ROS time. With a trigger command: at the share `trigger_exposure` of its run.
For a file from the watched folder: its modification time if that is recent, less `file_delay`. For a file named to
`ingest_file`: the time in its header, else its modification time. Where ROS time is simulated, or the file's time is
implausible, the time of reading takes its place.
"""

import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dm_msgs.msg import MirrorInfo, SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from dm_msgs.srv import IngestFile, Measure
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from dm_calibration.acquisition import interferometer_messages as messages
from dm_calibration.acquisition.acquisition import Acquisition, measured_ns
from dm_calibration.acquisition.ingest import Ingest, IngestSettings, too_large
from dm_calibration.acquisition.sensor import SensorAcquisition, read_sensor
from dm_calibration.interferometer_parameters import PARAMETERS, configure
from dm_calibration.map_files import MapFileError, SurfaceMap
from dm_calibration.map_files.datx_structure import as_text
from dm_calibration.optics.orientation import Orientation
from dm_common.errors import CodedError, ErrorCode, Refusal
from dm_common.figures import counted
from dm_common.measurement import Measurement
from dm_common.messages import stamp_ns, time_message
from dm_common.ros import parameters, qos
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import ERROR, OK, WARN, Health, ManagedNode
from dm_common.ros.worker import WorkerService
from dm_common.values import Fields, from_values, real, text

#: Allowed values of the fields of its requests.
MEASURE = Fields({"label": text(""), "timeout": real(0.0, 1e-3, 86400.0, "s", zero="as configured")})
INGEST_FILE = Fields({"path": text("")})


class InterferometerNode(ManagedNode):
    """Converts between map files and messages; reading and fitting are in `ingest` and `acquisition`."""

    requires_activation = False

    def __init__(self) -> None:
        self._mirror_radius = 0.0  # m; 0 = not known
        super().__init__("interferometer", PARAMETERS, check=self._fits_mirror, hardware_id="interferometer")
        self._ingest = Ingest()
        self._reference: SurfaceMap | None = None
        self._acquisition: Acquisition | SensorAcquisition | None = None
        self._sensor: Subscription | None = None
        self._map_publishers: tuple[Publisher, ...] = ()
        self._publishing = threading.Lock()  # keeps the four messages of one map together
        self._taken = self._bad = 0
        self._last_file = self._last_refusal = ""
        self._last_taken: Measurement | None = None
        self._published: dict[str, str] = {}  # path -> sha256 of maps from the watched folder
        # Exists in every lifecycle state: the lease of this topic shows other nodes that this one is alive.
        self._info_publisher = self.create_lifecycle_publisher(
            SurfaceMapInfo, "surface_map_info", qos.with_lease(qos.STATE)
        )
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        WorkerService(self, IngestFile, "ingest_file", self._on_ingest_file, INGEST_FILE)
        WorkerService(self, Measure, "measure", self._on_measure, MEASURE)

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror_radius = 0.5 * message.full_aperture_diameter

    def _fits_mirror(self, changes: Mapping[str, Any]) -> None:
        """Raise ParameterError for an aperture larger than the mirror, such as by a slip of the decimal point."""
        if wrong := too_large(changes.get("aperture.radius", 0.0), self._mirror_radius):
            raise parameters.ParameterError(wrong)

    def configure(self) -> None:
        settings, self._reference = configure(self._values, self.resolve_topic_name)
        self._acquisition = Acquisition(settings, self._read, self._now_ns, self._on_new_file, self._warn_of_file)
        if topic := self._values["zernike_topic"]:
            self._listen_to(topic)
        # Latched: viewers are opened after the map was taken. Subscribers with qos.MAP get later maps only.
        self._map_publishers = (
            self.create_lifecycle_publisher(Image, "surface_map", qos.LATCHED),
            self.create_lifecycle_publisher(ZernikeCoefficients, "zernike", qos.STATE),
            self.create_lifecycle_publisher(SurfaceSamples, "surface_samples", qos.STATE),
        )

    def _listen_to(self, topic: str) -> None:
        """Take measurements from a sensor instead of map files."""
        source = f"topic {self.resolve_topic_name(topic)}"
        self._acquisition = sensor = SensorAcquisition(
            source, lambda seen: read_sensor(seen, self._ingest, self._settings()), self._now_ns
        )

        def heard(message: ZernikeCoefficients) -> None:
            sensor.offer(lambda: messages.sensor_map(message, source), stamp_ns(message.header.stamp))

        self._sensor = self.create_subscription(ZernikeCoefficients, topic, heard, qos_profile_sensor_data)

    def activate(self) -> None:
        assert self._acquisition is not None
        self._acquisition.start()
        less = self._settings().corrections
        self.get_logger().info(f"active; maps from {self._acquisition.source}{less and f', less {less}'}")

    def deactivate(self) -> None:
        self.make_safe()

    def make_safe(self) -> None:
        """Stop the watching thread and a running trigger command."""
        self.active = False
        if self._acquisition is not None:
            self._acquisition.stop()

    def clean_up(self) -> None:
        with self._publishing:
            for publisher in self._map_publishers:
                self.destroy_lifecycle_publisher(publisher)
            self._map_publishers = ()
        if self._sensor is not None:
            self.destroy_subscription(self._sensor)
        self._acquisition = self._sensor = None

    def _on_ingest_file(self, request: IngestFile.Request, response: IngestFile.Response) -> IngestFile.Response:
        if not self.configured:
            raise Refusal(ErrorCode.INTERFEROMETER_INACTIVE, self.inactive())
        with self._counting_refusals():
            if not request.path:
                raise Refusal(ErrorCode.INVALID_ARGUMENT, "path is empty: must name a map file")
            try:
                path = Path(request.path).expanduser()
            except RuntimeError as error:
                raise MapFileError(f"{request.path}: {error}") from error
            surface, measured = self._read(path)
        header = self._header(self._file_time(surface, believe_header=True))
        return self._accept(response, surface, measured, header, "ingested", publish=True)

    def _on_measure(self, request: Measure.Request, response: Measure.Response) -> Measure.Response:
        acquisition = self._acquisition
        if (reason := self.inactive()) or acquisition is None:
            raise Refusal(ErrorCode.INTERFEROMETER_INACTIVE, reason)
        timeout_s = request.timeout or self._values["measure_timeout"]
        with self._counting_refusals():
            surface, measured = acquisition.acquire(timeout_s)
        header = self._header(measured.stamp_ns or self._file_time(surface, believe_header=False))
        what = f"measured {request.label}".strip()
        return self._accept(response, surface, measured, header, what, publish=not request.answer_only)

    def _on_new_file(self, path: Path) -> None:
        """Take a new file in the watched folder that no request waits for; runs in the watching thread."""
        try:
            self._take(path)
        except Exception as error:  # no file may keep the next one from being taken
            known = isinstance(error, CodedError)
            self._warn_of_file(str(error) if known else f"{as_text(path)}: {type(error).__name__}: {error}")

    def _take(self, path: Path) -> None:
        surface, measured = self._read(path)
        # The digest takes longer than the fit, so it is computed before publishing only if the file may be unchanged.
        before = self._published.pop(str(path), None)
        known = before is not None and before == surface.sha256
        if self.active and not known:
            self._publish(surface, measured, self._header(self._file_time(surface, believe_header=False)))
            self._log_taken(surface, measured, "new file")
        self._published[str(path)] = surface.sha256
        while len(self._published) > 1000:
            self._published.pop(next(iter(self._published)))

    def _read(self, path: Path) -> tuple[SurfaceMap, Measurement]:
        return self._ingest.read(path, self._settings())

    def _settings(self) -> IngestSettings:
        values = self._values
        return from_values(
            IngestSettings,
            values,
            orientation=from_values(Orientation, values, "orientation."),
            mirror_radius=self._mirror_radius,
            aperture_centre=(values["aperture.centre_x"], values["aperture.centre_y"]),
            reference=self._reference,
        )

    def _accept(
        self, response: Any, surface: SurfaceMap, measured: Measurement, header: Header, what: str, *, publish: bool
    ) -> Any:
        if publish and self.active:
            self._publish(surface, measured, header)
        self._log_taken(surface, measured, what)
        name = Path(surface.file).name or surface.instrument
        shown = f"rms {surface.rms * 1e9:.1f} nm, {measured.valid_fraction:.1%} valid"
        response.message = f"{what}: {name}, {shown}{_mended(surface)}"
        response.info = messages.info_message(surface, measured, header)
        response.zernike = messages.zernike_message(measured, header)
        response.samples = messages.samples_message(measured, header)
        return response

    def _publish(self, surface: SurfaceMap, measured: Measurement, header: Header) -> None:
        with self._publishing:
            if not self._map_publishers:
                return
            surface_map, zernike, samples = self._map_publishers
            # The most urgent messages first: map and digest take longer than all others.
            zernike.publish(messages.zernike_message(measured, header))
            samples.publish(messages.samples_message(measured, header))
            self._info_publisher.publish(messages.info_message(surface, measured, header))
            if self._values["publish_map"]:
                surface_map.publish(messages.image_message(surface, header))

    def _log_taken(self, surface: SurfaceMap, measured: Measurement, what: str) -> None:
        self._taken += self._last_taken is None or not measured.same_map(self._last_taken)
        self._last_taken, self._last_file, self._last_refusal = measured, surface.file, ""
        shown = f"PV {surface.pv * 1e9:.1f} nm, rms {surface.rms * 1e9:.1f} nm, {measured.valid_fraction:.1%} valid"
        self.get_logger().info(f"{what}: {surface.file or surface.instrument}: {shown}{_mended(surface)}")
        if surface.pitch is None:
            self.get_logger().warning(
                f"{surface.file}: the file states no lateral resolution, so coefficients carry radius 0 (unknown); "
                "set the parameter `pitch` [m per pixel]",
                once=True,
            )

    @contextmanager
    def _counting_refusals(self) -> Iterator[None]:
        try:
            yield
        except CodedError as error:
            self._bad, self._last_refusal = self._bad + 1, str(error)
            raise

    def _warn_of_file(self, reason: str) -> None:
        self._bad, self._last_refusal = self._bad + 1, reason
        self.get_logger().warning(reason)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp=time_message(stamp_ns), frame_id=parameters.frame_id(self, self._values["frame_id"]))

    def _file_time(self, surface: SurfaceMap, believe_header: bool) -> int:
        now = self._now_ns()
        time = now if self.get_clock().ros_time_is_active else measured_ns(surface, now, believe_header)
        return time if believe_header else max(0, time - round(1e9 * self._values["file_delay"]))

    def health(self) -> Health:
        acquisition = self._acquisition
        trouble = acquisition.folder_trouble if acquisition is not None and self.active else ""
        values = {
            "active": self.active,
            "watch_folder": self._values["watch_folder"],
            "maps_taken": self._taken,
            "files_refused": self._bad,
            "last_file": self._last_file,
            "last_refusal": self._last_refusal,
        }
        trouble = trouble or too_large(self._values["aperture.radius"], self._mirror_radius)
        if trouble:
            return Health(ERROR, trouble, values)
        if self._last_refusal:
            return Health(WARN, f"refused: {self._last_refusal}", values)
        return Health(OK, "active" if self.active else "inactive", values)


def _mended(surface: SurfaceMap) -> str:
    count = surface.phase_steps
    return f", {counted(count, 'region')} brought back by whole fringes" if count else ""


def main() -> int:
    """Run the node until SIGINT or SIGTERM."""
    return run_node(InterferometerNode)


if __name__ == "__main__":
    sys.exit(main())
