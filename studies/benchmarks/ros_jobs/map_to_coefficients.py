"""Time from a map file on disk to coefficients published by the interferometer node, beside its parts.

By service `ingest_file`, which names a complete file, and from the watched folder, where a file is taken once its
writer has closed it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from dm_msgs.msg import ZernikeCoefficients
from dm_msgs.srv import IngestFile
from std_msgs.msg import Header

from dm_bringup.nodes import MODULES
from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.acquisition.interferometer_messages import image_message, zernike_message
from dm_calibration.map_files import read_map
from dm_calibration.optics.map_fit import MapFitter
from dm_common.optics.sampling import edge_clustered_points, sample_map
from dm_common.ros import qos
from dm_simulation.interferometer.zygo_files import encode_dat, encode_datx
from studies.benchmarks.ros_jobs.ros_processes import ProcessHarness, process_harness
from studies.benchmarks.sample_maps import CAMERA, full_aperture, maps
from studies.benchmarks.timing import Effort, medians

PITCH, WAVELENGTH = 25e-6, 632.8e-9
RADIUS = PITCH * CAMERA / 2
#: Number of maps used in turn, each with dropouts of its own.
MAPS = 6
PAUSE_S = 0.05
ARRIVAL_S, REST_S = 20.0, 2.0


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `file_to_coefficients`, in ms; `.datx` under `datx`, the folder under `watched`, the parts under `parts`.

    Raises:
        RuntimeError: the node ended, or published no coefficients.
    """
    generator = np.random.default_rng(20)
    sags = [maps(CAMERA, 1, generator)[0][0] for _ in range(2 if effort.quick else MAPS)]
    contents = {
        suffix: [encode(sag, PITCH, WAVELENGTH, 0) for sag in sags]
        for suffix, encode in (("dat", encode_dat), ("datx", encode_datx))
    }
    rounds = 10 if effort.quick else 200
    with process_harness() as harness:
        node = _Interferometer(harness)
        named = {suffix: [node.named(some[0], suffix) for _ in range(2)] for suffix, some in contents.items()}
        # One kind after the other: after a .datx, the helper process for the next one starts, beside whatever follows.
        for suffix, some in contents.items():
            for number in range(rounds if suffix == "dat" else rounds // 5):
                named[suffix].append(node.named(some[number % len(some)], suffix))
            node.rest()
        watched = [node.watched(contents["dat"][number % len(sags)]) for number in range(rounds // 10)]
    figures = {suffix: _percentiles(times[2:]) for suffix, times in named.items()}
    watched_figures = _percentiles(watched)
    return {
        "file_to_coefficients": figures["dat"]
        | {"datx": figures["datx"], "watched": watched_figures, "parts": _parts(contents, effort)}
    }


class _Interferometer:
    """The node under test."""

    def __init__(self, harness: ProcessHarness) -> None:
        self._harness, self._numbers = harness, count()
        self._arrived: list[float] = []
        self._folder = harness.folder / "maps"
        self._folder.mkdir()
        harness.node.create_subscription(
            ZernikeCoefficients, "/maps/zernike", lambda _message: self._arrived.append(time.perf_counter()), qos.STATE
        )
        self._ingest = harness.node.create_client(IngestFile, "/maps/ingest_file")
        parameters = {"watch_folder": str(self._folder), "aperture.radius": RADIUS}
        harness.start(MODULES["interferometer"], namespace="maps", parameters=parameters)
        harness.wait_for("the interferometer", lambda: harness.node.count_publishers("/maps/zernike"))
        harness.wait_for("its service", self._ingest.service_is_ready)
        harness.serve(1.0)

    def named(self, content: bytes, suffix: str) -> float:
        """Time from naming a new file to its coefficients, s."""
        path = self._harness.folder / f"{next(self._numbers)}.{suffix}"
        path.write_bytes(content)
        self._arrived.clear()
        requested = time.perf_counter()
        answer = self._ingest.call_async(IngestFile.Request(path=str(path)))
        return self._await(path, requested, answer.done)

    def rest(self) -> None:
        """Wait until all background work is over."""
        self._harness.serve(REST_S)

    def watched(self, content: bytes) -> float:
        """Time from the moment a new file is closed to its coefficients, s."""
        path = self._folder / f"{next(self._numbers)}.dat"
        self._arrived.clear()
        with path.open("wb", buffering=0) as file:
            file.write(content)
            closed = time.perf_counter()
        return self._await(path, closed, lambda: True)

    def _await(self, path: Path, since: float, done: Callable[[], bool]) -> float:
        self._harness.wait_for(f"coefficients of {path.name}", lambda: self._arrived and done(), ARRIVAL_S)
        seconds = self._arrived[0] - since
        self._harness.serve(PAUSE_S)
        path.unlink()
        return seconds


def _percentiles(seconds: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(1e3 * np.array(seconds), (50, 99))
    return {"p50_ms": float(p50), "p99_ms": float(p99)}


def _parts(contents: dict[str, list[bytes]], effort: Effort) -> dict[str, float]:
    """Medians of the steps, ms, in this process."""
    with process_harness() as harness:
        paths: dict[str, list[Path]] = {suffix: [] for suffix in contents}
        for suffix, some in contents.items():
            for number, content in enumerate(some):
                paths[suffix].append(harness.folder / f"{number}.{suffix}")
                paths[suffix][-1].write_bytes(content)
        turn = iter(range(10**9))

        def path(suffix: str) -> Path:
            return paths[suffix][next(turn) % len(paths[suffix])]

        ingest, settings, header = Ingest(), IngestSettings(aperture_radius=RADIUS), Header()
        surface, measurement = ingest.read(path("dat"), settings)
        sag, aperture, points = surface.sag, full_aperture(CAMERA), edge_clustered_points(500)
        circle = (aperture.centre_x_px, aperture.centre_y_px, aperture.radius_px)
        valid = np.isfinite(sag)
        fitter = MapFitter(valid, *circle)
        jobs = {
            "read_dat": lambda: read_map(path("dat")),
            "read_datx": lambda: read_map(path("datx")),
            "new_mask": lambda: MapFitter(valid, *circle),
            "fit": lambda: fitter.fit(sag),
            "sample": lambda: sample_map(sag, *circle, points),
            "ingest_dat": lambda: ingest.read(path("dat"), settings),
            "coefficients_message": lambda: zernike_message(measurement, header),
            "map_message": lambda: image_message(surface, header),
        }
        return {f"{name}_ms": 1e3 * seconds for name, seconds in medians(jobs, max(effort.rounds // 3, 4)).items()}
