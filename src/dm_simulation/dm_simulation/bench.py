"""The whole virtual bench: drive unit, mirror, interferometer, camera and their ports, without ROS."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dm_common.values import parameter, real, switch, text
from dm_simulation.camera import CameraConfig, SceneCamera
from dm_simulation.electronics.drive_unit import DriveConfig, DriveUnit
from dm_simulation.electronics.monitor import Monitor, MonitorConfig
from dm_simulation.electronics.server import OFF, ElectronicsServer, PortsConfig
from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.interferometer.trigger_server import TriggerServer
from dm_simulation.interferometer.zygo_files import FORMATS, UNITS, deliver, encode_dat, encode_datx, prune
from dm_simulation.mirror.membrane import Membrane, MembraneConfig
from dm_simulation.mirror.piezo import DRAWN, PiezoActuators, PiezoConfig
from dm_simulation.mirror.plate import Plate, PlateConfig, neighbour_pairs
from dm_simulation.mirror.zernike import Array


@dataclass(frozen=True)
class FilesConfig:
    """Map files: their folder and form, and the name of the part in them."""

    folder: Path = Path("maps")
    format: str = parameter(text("datx", choices=FORMATS), "Format of maps without a given path.")
    datx_unit: str = parameter(text("NanoMeters", choices=UNITS), "Unit of the heights in .datx files.")
    intensity: bool = parameter(switch(False), "Whether .dat files have an intensity frame.")
    slow_write: float = parameter(real(0.0, 0.0, 60.0, "s"), "Wall time over which a file grows; 0 = it appears whole.")
    limit: float = parameter(
        real(5e8, 0.0, 1e15, "B"),
        "Size of all maps in output_folder above which the oldest are removed; 0 = all are kept.",
    )
    part_name: str = "PDM30-37"


@dataclass(frozen=True)
class BenchConfig:
    """Configuration of all parts of the bench. The seed fixes gains, initial figure and the noise of the n-th map.

    The mirror is the `membrane`, or if that is None the `plate` on `piezo` stacks.
    """

    seed: int = 1
    plate: PlateConfig = field(default_factory=PlateConfig)
    piezo: PiezoConfig = DRAWN
    membrane: MembraneConfig | None = None
    interferometer: InterferometerConfig = field(default_factory=InterferometerConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    drive: DriveConfig = field(default_factory=DriveConfig)
    ports: PortsConfig = field(default_factory=PortsConfig)
    monitor: MonitorConfig = field(default_factory=MonitorConfig)
    files: FilesConfig = field(default_factory=FilesConfig)
    trigger_port: int = 1235


class VirtualBench:
    """A running bench.

    Args:
        now: gives the bench's time in seconds, by which creep runs; monotonic except for clock jumps.
        on_event: called with (severe, text) from the bench's own threads.

    Raises:
        ValueError: an inconsistent configuration; the message names the parameter.
        OSError: a port is taken.
    """

    def __init__(
        self,
        config: BenchConfig,
        now: Callable[[], float] = time.monotonic,
        on_event: Callable[[bool, str], None] = lambda severe, text: None,
    ) -> None:
        self.config = config
        self._now = now
        self._on_event = on_event
        seeds = np.random.SeedSequence(config.seed).spawn(5)
        gains, figure, noise, scene, shot_noise = (np.random.default_rng(seed) for seed in seeds)
        self.unit = DriveUnit(config.drive)
        signals = self.unit.signals()
        self.plate: Plate | Membrane
        self.actuators: PiezoActuators | Membrane
        if config.membrane is None:
            self.plate = Plate(config.plate)
            self.actuators = PiezoActuators(config.piezo, gains, signals, now())
        else:
            self.plate = self.actuators = Membrane(config.membrane, gains, now(), config.drive.volts_max)
        if len(config.drive.wiring) != len(self.plate.x):
            raise ValueError(f"wiring: {len(config.drive.wiring)} channels given, {len(self.plate.x)} are needed")
        self._move()
        self.interferometer = Interferometer(config.interferometer, self.plate, figure, noise)
        self.camera: SceneCamera | None = None
        if config.camera.rate > 0:
            self.camera = SceneCamera(config.camera, config.interferometer.field_diameter, scene, shot_noise)
        self.monitor = Monitor(config.monitor, neighbour_pairs(self.plate.x, self.plate.y), signals)
        self.maps_written = 0
        self._measuring = threading.Lock()
        # Created at once, as on the instrument's PC, so that whoever watches the folder finds it before the first map.
        config.files.folder.mkdir(parents=True, exist_ok=True)
        if config.interferometer.instrument_error:
            reference = config.files.folder.absolute() / "reference"
            reference.mkdir(exist_ok=True)
            deliver(self._map_file(self.interferometer.reference(), ".datx", 0), reference / "flat.datx", 0.0)
        self.electronics = ElectronicsServer(self.unit, config.ports, self._on_frame, on_event)
        try:
            self.trigger = None if config.trigger_port == OFF else TriggerServer(config.trigger_port, self.measure)
        except OSError:
            self.electronics.close()
            raise

    @property
    def endpoints(self) -> dict[str, int | str]:
        """Actual ports and paths by name."""
        trigger = {} if self.trigger is None else {"trigger_port": self.trigger.port}
        return {**self.electronics.endpoints, **trigger}

    def _move(self) -> None:
        drive = self.unit.signals() if self.config.membrane is None else self.unit.actuator_volts()
        self.actuators.apply(drive, self._now())

    def _on_frame(self) -> None:
        self._move()
        wrong = self.monitor.watch(self.unit.signals())
        if wrong:
            self._on_event(True, wrong)

    def displacement(self) -> Array:
        """Base displacements (N,), m (of a membrane: pressures, Pa), at this moment, after all frames that arrived."""

        def sample() -> Array:
            self.actuators.advance(self._now())
            return self.actuators.displacement

        return self.electronics.run(sample)

    def temperature(self) -> float:
        """Present temperature of a plate on piezo stacks, degC."""
        assert isinstance(self.actuators, PiezoActuators)
        self.displacement()
        return self.actuators.temperature

    def photograph(self) -> NDArray[np.uint8]:
        """An image (height, width) of the scene through the true surface of the mirror at this moment.

        Raises:
            ValueError: the bench has no camera.
        """
        if self.camera is None:
            raise ValueError("camera.rate = 0: this bench has no camera")
        return self.camera.expose(self.interferometer.true_surface(self.displacement()))

    def measure(self, path: Path | None = None) -> Path:
        """Measure the surface at this moment and write the map file; the suffix of `path` gives the format.

        Returns:
            The path of the file: `path`, else map_<nnnnnn> in the output folder.

        Raises:
            ValueError: `path` is not absolute, or has another suffix than .dat or .datx.
            OSError: the file cannot be written.
        """
        files, instrument = self.config.files, self.interferometer
        if path is not None:
            _check_path(path)
        with self._measuring:
            displacement = self.displacement()
            now = self._now()
            sag = instrument.measure(displacement, now)
            if path is None:
                path = self._next_path()
            deliver(self._map_file(sag, path.suffix, int(now)), path, files.slow_write)
            if files.limit and path.parent == files.folder.absolute():
                prune(path.parent, files.limit, path)
            self.maps_written += 1
        return path

    def _map_file(self, sag: Array, suffix: str, stamp: int) -> bytes:
        """Content of a map file in the format given by `suffix`; `stamp`: Unix time of the measurement."""
        files, instrument = self.config.files, self.interferometer
        facts = (sag, instrument.pitch, instrument.config.wavelength, stamp)
        if suffix == ".dat":
            return encode_dat(*facts, intensity=files.intensity, part_name=files.part_name)
        return encode_datx(*facts, unit=files.datx_unit, part_name=files.part_name)

    def _next_path(self) -> Path:
        files, number = self.config.files, self.maps_written
        while (path := files.folder.absolute() / f"map_{number:06d}.{files.format}").exists():
            number += 1
        return path

    def close(self) -> None:
        """Free all ports and end all threads."""
        if self.trigger is not None:
            self.trigger.close()
        self.electronics.close()


def _check_path(path: Path) -> None:
    if not path.is_absolute():
        raise ValueError(f"path {str(path)!r}: must be absolute")
    if path.suffix.lstrip(".") not in FORMATS:
        raise ValueError(f"path {str(path)!r}: must end in .dat or .datx")
    if path.exists() and not path.is_file():
        raise ValueError(f"path {str(path)!r}: exists and is not a file")
