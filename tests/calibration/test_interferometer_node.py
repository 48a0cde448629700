"""The node `interferometer` as a process, over real DDS, with real files."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.msg import SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from dm_msgs.srv import IngestFile, Measure
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import Image

from dm_common.errors import ErrorCode
from dm_common.optics.zernike import TERMS, basis
from dm_common.ros import qos
from map_fixtures import WAVELENGTH, dat_bytes, disc_counts, write_datx
from support import NodeProcess, Observer, wait_until

Start = Callable[..., NodeProcess]
INVALID = 1.7976931348623157e308
PITCH = 0.022 / 100


def surface(tilt: float = 1e-7) -> np.ndarray:
    """Fringes of a map with 0.5 um of defocus and some tilt on a disc that fills it."""
    y, x = (np.mgrid[:100, :100] - 49.5) / 50
    coefficients = np.zeros(21)
    coefficients[[1, 3]] = [tilt, 5e-7]
    fringes = basis(x, -y) @ coefficients / (0.5 * WAVELENGTH)
    return np.where(x**2 + y**2 <= 1, fringes, INVALID)


class StartedInterferometer:
    """The observer's view of a started node."""

    def __init__(self, observer: Observer, start: Start, **parameters: Any) -> None:
        self.observer = observer
        self.maps = observer.record(Image, "surface_map", qos.MAP)
        self.infos = observer.record(SurfaceMapInfo, "surface_map_info", qos.STATE)
        self.zernikes = observer.record(ZernikeCoefficients, "zernike", qos.STATE)
        self.samples = observer.record(SurfaceSamples, "surface_samples", qos.STATE)
        self.health = observer.record(DiagnosticArray, "/diagnostics")
        values = {name.replace("__", "."): value for name, value in parameters.items()}
        self.node = start("dm_calibration", "interferometer", {"stable_time": 0.1, **values})
        self.wait_for_state(
            State.PRIMARY_STATE_ACTIVE if values.get("autostart", True) else State.PRIMARY_STATE_UNCONFIGURED
        )
        if values.get("autostart", True):
            wait_until(lambda: observer.node.count_publishers("surface_samples"), what="discovery")
            wait_until(lambda: "active; maps from" in self.node.output, what="activation")

    def wait_for_state(self, state: int) -> None:
        def reached() -> bool:
            answer = self.observer.call(GetState, "interferometer/get_state", timeout_s=30)
            return bool(answer.current_state.id == state)

        wait_until(reached, 60, f"lifecycle state {state}")

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.observer.call(ChangeState, "interferometer/change_state", request).success)

    def ingest(self, path: Path) -> Any:
        return self.observer.call(IngestFile, "ingest_file", IngestFile.Request(path=str(path)))

    def measure(self, **request: Any) -> Any:
        return self.observer.call(Measure, "measure", Measure.Request(**request), timeout_s=40)

    def wait_for_maps(self, count: int) -> None:
        kinds = (self.maps, self.infos, self.zernikes, self.samples)
        wait_until(lambda: all(len(received) >= count for received in kinds), 60, f"{count} maps")


def test_ingested_map_is_published_whole(observer: Observer, start: Start, tmp_path: Path) -> None:
    bench = StartedInterferometer(observer, start)
    path = tmp_path / "map.dat"
    counts = disc_counts(100, amplitude=20000)
    path.write_bytes(dat_bytes(counts, pitch=PITCH))
    answer = bench.ingest(path)
    assert answer.error_code == ErrorCode.OK and answer.message.startswith("ingested: map.dat, rms")
    bench.wait_for_maps(1)

    sag = np.where(counts < 2147483640, counts * 0.5 * WAVELENGTH / 32768, np.nan)
    image = bench.maps[0]
    assert (image.encoding, image.height, image.width, image.step) == ("32FC1", 100, 100, 400)
    np.testing.assert_allclose(np.frombuffer(image.data, "<f4").reshape(100, 100), sag, rtol=1e-6)

    info = bench.infos[0]
    assert info == answer.info
    assert info.pv == pytest.approx(np.ptp(sag[np.isfinite(sag)]), rel=1e-6)
    assert info.rms == pytest.approx(np.nanstd(sag), rel=1e-6)
    assert info.aperture_radius == pytest.approx(0.011, rel=0.01)
    assert (info.centre_x, info.centre_y) == pytest.approx((49.5, 49.5), abs=0.2)
    assert info.file == str(path)
    assert len(info.sha256) == 64
    assert not info.piston_tilt_removed

    zernike = bench.zernikes[0]
    assert zernike == answer.zernike
    assert zernike.convention == "born_wolf" and zernike.wavelength > 0.0
    amplitude = 20000 * 0.5 * WAVELENGTH / 32768  # of r^2 = (Z_2^0 + 1) / 2, and a tenth of it in x
    np.testing.assert_allclose(
        np.array(zernike.coefficients)[:4], np.array([0.5, 0.1, 0, 0.5]) * amplitude, atol=0.004 * amplitude
    )
    assert len(zernike.sigma) == 21
    assert 0 < max(zernike.sigma) < 1e-9
    # counts scatter evenly over 7 values
    assert zernike.residual_rms == pytest.approx(2 * 0.5 * WAVELENGTH / 32768, rel=0.05)

    samples = bench.samples[0]
    assert samples == answer.samples
    assert len(samples.sag) == 500
    expected = amplitude * (np.array(samples.x) ** 2 + np.array(samples.y) ** 2 + 0.1 * np.array(samples.x))
    np.testing.assert_allclose(samples.sag, expected, atol=0.04 * amplitude)
    stamps = {(m.header.stamp.sec, m.header.frame_id) for m in (image, info, zernike, samples)}
    assert stamps == {(1429905292, "mirror")}
    late = observer.record(Image, "surface_map", qos.LATCHED)
    wait_until(lambda: late, what="the map of before")


def test_map_of_a_large_fizeau(observer: Observer, start: Start, tmp_path: Path) -> None:
    """As such an instrument leaves it: an intensity frame of the whole camera before the phase, a rim without data."""
    counts = np.pad(disc_counts(400, 34000), 10, constant_values=2147483640)
    fields: dict[str, Any] = {
        "intensity": np.full((1, 480, 640), 200),
        "pitch": 117.9e-6,
        "origin_x": 116,
        "origin_y": 30,
    }
    path = tmp_path / "fizeau.dat"
    path.write_bytes(dat_bytes(counts, **fields))
    sag = np.where(counts < 2147483640, counts * 0.5 * WAVELENGTH / 32768, np.nan)
    bench = StartedInterferometer(observer, start)
    answer = bench.ingest(path)
    assert answer.error_code == ErrorCode.OK
    assert answer.info.pv == pytest.approx(np.ptp(sag[np.isfinite(sag)]), rel=1e-6)
    assert answer.info.rms == pytest.approx(np.nanstd(sag), rel=1e-6)
    assert answer.info.pitch == pytest.approx(117.9e-6, rel=1e-3)
    bench.wait_for_maps(1)
    assert bench.infos[0].sha256 == answer.info.sha256


def test_bad_files_get_their_code_and_words_and_the_node_goes_on(
    observer: Observer, start: Start, tmp_path: Path
) -> None:
    bench = StartedInterferometer(observer, start, wavelength__expected=WAVELENGTH)
    good = dat_bytes(disc_counts(60), pitch=PITCH)
    bad: dict[str, tuple[bytes | None, int, str]] = {
        "absent.dat": (None, ErrorCode.MAP_UNREADABLE, "No such file"),
        "text.dat": (b"hello", ErrorCode.MAP_UNREADABLE, "not a ZYGO"),
        "short.dat": (good[:-5], ErrorCode.MAP_UNREADABLE, "truncated"),
        "long.dat": (good + b"12345", ErrorCode.MAP_UNREADABLE, "longer than its header says"),
        "zero.dat": (dat_bytes(disc_counts(60), W=0.0), ErrorCode.MAP_UNREADABLE, "wavelength = 0"),
        "units.xyz": (b"Zygo XYZ Data File - Format 1\n", ErrorCode.MAP_UNREADABLE, "xyz_unit = not given"),
        "empty.dat": (dat_bytes(np.full((9, 9), 2147483640)), ErrorCode.MAP_INSUFFICIENT, "none of the 9 x 9"),
        "tiny.dat": (dat_bytes(disc_counts(4)), ErrorCode.MAP_INSUFFICIENT, "21 terms"),
        "green.dat": (dat_bytes(disc_counts(60), W=532e-9), ErrorCode.MAP_REJECTED, "wavelength = 532.000 nm"),
    }
    for name, (content, code, words) in bad.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        answer = bench.ingest(tmp_path / name)
        assert answer.error_code == code, name
        assert words in answer.message
        assert str(tmp_path / name) in answer.message
    write_datx(tmp_path / "mtf.datx", surface(), "NoUnits")
    answer = bench.ingest(tmp_path / "mtf.datx")
    assert (answer.error_code, "NoUnits" in answer.message) == (ErrorCode.MAP_UNREADABLE, True)
    (tmp_path / "good.dat").write_bytes(good)
    assert bench.ingest(tmp_path / "good.dat").error_code == ErrorCode.OK
    bench.wait_for_maps(1)
    assert len(bench.zernikes) == 1
    assert bench.ingest(tmp_path / "good.dat").error_code == ErrorCode.OK, "again: it counts once"
    (tmp_path / "other.dat").write_bytes(dat_bytes(disc_counts(50), pitch=PITCH))
    assert bench.ingest(tmp_path / "other.dat").error_code == ErrorCode.OK
    bench.wait_for_maps(3)
    counted = {("maps_taken", "2"), ("files_refused", "10")}
    health = wait_until(lambda: [array for array in bench.health if counted <= pairs(array)], what="the counts")
    assert (health[0].status[0].name, health[0].status[0].level) == ("interferometer", b"\0")


def test_watched_folder_takes_whole_new_files_once(observer: Observer, start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    write_datx(folder / "old.datx", surface(), pitch=PITCH)
    bench = StartedInterferometer(observer, start, watch_folder=str(folder), file_delay=1000.0, remove_piston_tilt=True)
    write_datx(tmp_path / "new.datx", surface(), pitch=PITCH)
    content = (tmp_path / "new.datx").read_bytes()
    with (folder / "growing.datx").open("wb") as file:
        for begin in range(0, len(content), len(content) // 8):
            file.write(content[begin : begin + len(content) // 8])
            file.flush()
            time.sleep(0.03)
    bench.wait_for_maps(1)
    assert bench.infos[0].file == str(folder / "growing.datx")
    assert bench.infos[0].piston_tilt_removed
    assert bench.infos[0].rms == pytest.approx(5e-7 / np.sqrt(3), rel=0.01)
    assert bench.zernikes[0].coefficients[1] == pytest.approx(1e-7, rel=0.02)  # the tilt stays in the coefficients
    assert abs(bench.zernikes[0].header.stamp.sec + 1000.0 - time.time()) < 60  # of the exposure

    # Names of a machine with another code page, which no message can hold as they are.
    (folder / os.fsdecode(b"br\xfcche.dat")).write_bytes(b"no map")
    wait_until(lambda: "che.dat" in bench.node.output, what="the warning")
    (folder / "growing.datx").touch()  # nothing new in it
    (tmp_path / "new.datx").rename(folder / os.fsdecode(b"Pr\xfcfung.datx"))
    bench.wait_for_maps(2)
    assert [info.file for info in bench.infos] == [str(folder / "growing.datx"), str(folder / "Pr\\udcfcfung.datx")]
    assert bench.node.output.count("che.dat") == 1
    wait_until(lambda: any(("files_refused", "1") in pairs(array) for array in bench.health), what="the count")


def pairs(array: DiagnosticArray) -> set[tuple[str, str]]:
    return {(value.key, value.value) for value in array.status[0].values}


def test_a_triggered_map_is_published_once_or_answered_only(observer: Observer, start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    write_datx(tmp_path / "source.datx", surface(), pitch=PITCH)
    code = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
    bench = StartedInterferometer(
        observer,
        start,
        watch_folder=str(folder),
        trigger_command=[sys.executable, "-S", "-c", code, str(tmp_path / "source.datx"), "{path}"],
        aperture__radius=0.011,
    )
    before = observer.node.get_clock().now().nanoseconds
    answer = bench.measure(label="p55")
    after = observer.node.get_clock().now().nanoseconds
    assert answer.error_code == ErrorCode.OK and answer.message.startswith("measured p55: ")
    stamp = answer.zernike.header.stamp
    assert before <= stamp.sec * 10**9 + stamp.nanosec <= after
    expected = np.zeros(21)
    expected[[1, 3]] = [1e-7, 5e-7]
    np.testing.assert_allclose(answer.zernike.coefficients, expected, atol=1e-14)
    assert answer.zernike.radius == pytest.approx(0.011)
    assert Path(answer.info.file).parent == folder
    alone = bench.measure(label="sphere", answer_only=True)
    assert alone.error_code == ErrorCode.OK and alone.zernike.coefficients == answer.zernike.coefficients
    (folder / "by_hand.datx").write_bytes((tmp_path / "source.datx").read_bytes())
    bench.wait_for_maps(2)
    assert [info.file for info in bench.infos] == [answer.info.file, str(folder / "by_hand.datx")]
    assert "measured p55" in bench.node.output


@pytest.mark.parametrize(
    ("code", "expected", "words"),
    [
        ("import sys; sys.exit('laser is off')", ErrorCode.TRIGGER_FAILED, "laser is off"),
        ("import time; time.sleep(600)", ErrorCode.TRIGGER_FAILED, "did not end within 1 s"),
        ("pass", ErrorCode.MAP_TIMEOUT, "did not appear in time"),
        ("import sys; open(sys.argv[1], 'w').write('junk')", ErrorCode.MAP_UNREADABLE, "not a ZYGO"),
    ],
)
def test_failing_trigger(
    observer: Observer, start: Start, tmp_path: Path, code: str, expected: int, words: str
) -> None:
    bench = StartedInterferometer(
        observer,
        start,
        watch_folder=str(tmp_path),
        trigger_command=[sys.executable, "-S", "-c", code, "{path}"],
        trigger_timeout=1.0,
        measure_timeout=2.0,
    )
    answer = bench.measure()
    assert answer.error_code == expected
    assert words in answer.message
    assert bench.zernikes == []
    assert bench.node.running


def test_lifecycle(observer: Observer, start: Start, tmp_path: Path) -> None:
    path = tmp_path / "map.datx"
    write_datx(path, surface(), pitch=PITCH)
    folder = tmp_path / "maps"
    folder.mkdir()
    bench = StartedInterferometer(observer, start, autostart=False, watch_folder=str(folder))
    assert bench.measure().error_code == ErrorCode.INTERFEROMETER_INACTIVE
    assert bench.ingest(path).error_code == ErrorCode.INTERFEROMETER_INACTIVE
    assert bench.change(Transition.TRANSITION_CONFIGURE)
    assert bench.measure().error_code == ErrorCode.INTERFEROMETER_INACTIVE
    (folder / "unseen.datx").write_bytes(path.read_bytes())
    assert bench.ingest(path).error_code == ErrorCode.OK  # read and answered, but not published
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    wait_until(lambda: observer.node.count_publishers("surface_samples"), what="discovery")
    bench.measure(timeout=0.3)
    assert bench.zernikes == []
    assert bench.ingest(path).error_code == ErrorCode.OK
    bench.wait_for_maps(1)
    assert bench.change(Transition.TRANSITION_DEACTIVATE)
    assert bench.measure().error_code == ErrorCode.INTERFEROMETER_INACTIVE
    assert bench.change(Transition.TRANSITION_CLEANUP)
    assert bench.change(Transition.TRANSITION_CONFIGURE)
    assert bench.change(Transition.TRANSITION_ACTIVATE)
    assert bench.node.stop() == 0
    assert "Traceback" not in bench.node.output


def test_deactivation_ends_a_measurement(observer: Observer, start: Start, tmp_path: Path) -> None:
    marker = tmp_path / "started"
    code = "import sys, time; open(sys.argv[1], 'w').close(); time.sleep(600)"
    bench = StartedInterferometer(
        observer,
        start,
        watch_folder=str(tmp_path),
        trigger_command=[sys.executable, "-S", "-c", code, str(marker), "{path}"],
        trigger_timeout=300.0,
    )
    client = observer.node.create_client(Measure, "measure")
    wait_until(client.service_is_ready, what="service measure")
    future = client.call_async(Measure.Request(timeout=300.0))
    wait_until(marker.exists, 60, "the trigger command runs")
    assert bench.change(Transition.TRANSITION_DEACTIVATE)
    wait_until(future.done, 60, "the answer")
    assert future.result().error_code == ErrorCode.INTERFEROMETER_INACTIVE


def test_map_without_pitch_has_an_unknown_radius(observer: Observer, start: Start, tmp_path: Path) -> None:
    path = tmp_path / "map.dat"
    path.write_bytes(dat_bytes(disc_counts(60), pitch=0.0))
    bench = StartedInterferometer(observer, start)
    answer = bench.ingest(path)
    assert answer.error_code == ErrorCode.OK
    assert (answer.info.pitch, answer.info.aperture_radius, answer.zernike.radius) == (0,) * 3
    wait_until(lambda: "set the parameter `pitch`" in bench.node.output, what="the warning")


def test_settings_that_contradict_each_other_are_told_and_the_node_stays(observer: Observer, start: Start) -> None:
    node = start("dm_calibration", "interferometer", {"trigger_command": ["trigger"]})
    wait_until(lambda: "trigger_command needs watch_folder" in node.output, 60, "the reason")
    answer = observer.call(Measure, "measure", timeout_s=30)
    assert answer.error_code == ErrorCode.INTERFEROMETER_INACTIVE
    state = observer.call(GetState, "interferometer/get_state")
    assert state.current_state.id == State.PRIMARY_STATE_UNCONFIGURED


def test_neither_trigger_nor_folder(observer: Observer, start: Start) -> None:
    answer = StartedInterferometer(observer, start).measure()
    assert answer.error_code == ErrorCode.NOT_SUPPORTED
    assert "neither trigger_command nor watch_folder" in answer.message


def test_a_sensor_on_a_topic_takes_the_place_of_map_files(observer: Observer, start: Start) -> None:
    bench = StartedInterferometer(observer, start, zernike_topic="wavefront/zernike")
    publisher = observer.node.create_publisher(ZernikeCoefficients, "wavefront/zernike", 10)
    coefficients = 1e-7 * np.arange(21.0)
    seen = ZernikeCoefficients(convention="fringe", radius=0.011, residual_rms=5e-9)
    fringe = dict(zip([term.fringe_index for term in TERMS], coefficients.tolist(), strict=True))
    seen.coefficients = [fringe.get(index, 0.0) for index in range(1, max(fringe) + 1)]

    def stream() -> None:
        seen.header.stamp = observer.node.get_clock().now().to_msg()
        publisher.publish(seen)

    timer = observer.node.create_timer(0.02, stream)
    answer = bench.measure(label="poke")
    observer.node.destroy_timer(timer)
    assert answer.error_code == ErrorCode.OK and answer.message.startswith("measured poke: topic /"), answer.message
    np.testing.assert_allclose(answer.zernike.coefficients, coefficients, atol=1e-12)
    assert answer.zernike.convention == "born_wolf" and answer.zernike.residual_rms == 5e-9
    assert answer.info.aperture_radius == pytest.approx(0.011) and not answer.info.file
    bench.wait_for_maps(1)
    assert len(bench.zernikes) == 1  # not everything that the sensor sees
