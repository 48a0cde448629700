"""Zernike coefficients from a sensor as measurements: every convention, waiting, refusals."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import ZernikeCoefficients
from std_msgs.msg import Header

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.acquisition.interferometer_messages import sensor_map, zernike_message
from dm_calibration.acquisition.sensor import SensorAcquisition, read_sensor
from dm_calibration.interferometer_parameters import PARAMETERS, configure
from dm_calibration.optics.aperture import MapRejectedError
from dm_common.errors import ErrorCode, Refusal
from dm_common.optics.zernike import TERM_RMS, TERMS, basis

RADIUS = 0.011
WANTED = 1e-7 * np.random.default_rng(5).standard_normal(21)


def placed(values: np.ndarray, indices: list[int]) -> np.ndarray:
    result = np.zeros(max(indices) + 1)
    result[indices] = values
    return result


CONVERTED = {
    "born_wolf": WANTED,
    "noll": np.append(placed(WANTED * TERM_RMS, [term.noll_index - 1 for term in TERMS]), [3e-8] * 15),
    "ansi": placed(WANTED * TERM_RMS, [term.ansi_index for term in TERMS]),
    "fringe": np.append(placed(WANTED, [term.fringe_index - 1 for term in TERMS]), [3e-8] * 10),
}


def message(convention: str = "born_wolf", **fields: Any) -> ZernikeCoefficients:
    values = {"coefficients": list(CONVERTED[convention]), "radius": RADIUS, "residual_rms": 4e-9, **fields}
    return ZernikeCoefficients(convention=convention, **values)


@pytest.mark.parametrize("convention", CONVERTED)
@pytest.mark.parametrize("settings", [IngestSettings(), IngestSettings(aperture_radius=RADIUS)])
def test_coefficients_in_any_convention_become_a_measurement(convention: str, settings: IngestSettings) -> None:
    surface, found = read_sensor(sensor_map(message(convention), "topic /wavefront"), Ingest(), settings)
    np.testing.assert_allclose(found.coefficients, WANTED, atol=1e-14)
    np.testing.assert_allclose(found.sag, basis(found.points.x, found.points.y) @ WANTED, atol=1e-14)
    assert (found.radius, found.residual_rms, found.instrument) == (pytest.approx(RADIUS), 4e-9, "topic /wavefront")
    assert found.valid_fraction > 0.99 and surface.file == found.file == ""
    assert not zernike_message(found, Header()).sigma, "what a sensor's terms are right to is not known"


def test_a_smaller_aperture_of_the_mirror_is_cut_out() -> None:
    _, found = read_sensor(sensor_map(message(), "t"), Ingest(), IngestSettings(aperture_radius=0.8 * RADIUS))
    inside = basis(0.8 * found.points.x, 0.8 * found.points.y) @ WANTED
    np.testing.assert_allclose(found.sag, inside, atol=1e-14)
    assert found.radius == pytest.approx(0.8 * RADIUS)


@pytest.mark.parametrize("radius", [0.0, 0.9 * RADIUS])
def test_an_aperture_that_the_sensor_does_not_see_is_refused(radius: float) -> None:
    small = message()
    small.radius = radius
    with pytest.raises(MapRejectedError, match=f"radius = {radius:g} m: must be at least aperture.radius = {RADIUS:g}"):
        read_sensor(sensor_map(small, "t"), Ingest(), IngestSettings(aperture_radius=RADIUS))


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (
            {"coefficients": [0.0] * 20},
            r"topic /wavefront: coefficients of shape \(20,\): the last axis must have 21 terms",
        ),
        ({"convention": "fringe", "coefficients": [0.0] * 26}, "must have at least 27 terms"),
        ({"convention": "zernike"}, "convention = 'zernike': must be one of born_wolf, noll, ansi, fringe"),
        ({"coefficients": [np.nan] * 21}, "coefficients = nan: must be finite"),
        ({"radius": np.inf}, "radius = inf: must be finite"),
        ({"coefficients": [0.3] * 21}, "coefficients up to 0.3 m: must be 0.001 m or less; in m?"),
    ],
)
def test_what_is_no_measurement_is_refused(fields: dict[str, Any], text: str) -> None:
    bad = message()
    for name, value in fields.items():
        setattr(bad, name, value)
    with pytest.raises(MapRejectedError, match=text):
        sensor_map(bad, "topic /wavefront")


def test_the_first_measurement_after_the_request_counts() -> None:
    sensor = SensorAcquisition(
        "topic /wavefront", lambda seen: read_sensor(seen, Ingest(), IngestSettings()), lambda: 100
    )
    sensor.start()
    waiting = threading.Event()

    def stream() -> None:
        waiting.wait(5.0)
        for stamp in (99, 150, 160):
            sensor.offer(partial(sensor_map, message(coefficients=[1e-9 * stamp] * 21), "t"), stamp)

    thread = threading.Thread(target=stream)
    thread.start()
    sensor.offer(lambda: pytest.fail("nobody waits"), 200)
    threading.Timer(0.05, waiting.set).start()
    _, measured = sensor.acquire(5.0)
    thread.join()
    assert measured.stamp_ns == 150
    assert measured.coefficients[3] == pytest.approx(150e-9)


def test_waiting_ends_in_time_and_when_it_is_stopped() -> None:
    sensor = SensorAcquisition("topic /wavefront", lambda seen: pytest.fail("nothing was seen"), lambda: 100)
    sensor.start()
    with pytest.raises(Refusal, match=r"came on topic /wavefront within 0.01 s") as late:
        sensor.acquire(0.01)
    assert late.value.error_code == ErrorCode.MAP_TIMEOUT
    threading.Timer(0.05, sensor.stop).start()
    with pytest.raises(Refusal) as stopped:
        sensor.acquire(5.0)
    assert stopped.value.error_code == ErrorCode.INTERFEROMETER_INACTIVE


def test_a_topic_of_another_namespace_is_not_the_nodes_own() -> None:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    for topic, own in (("/zernike", False), ("/left/zernike", True), ("zernike", True), ("sensor/zernike", False)):
        with pytest.raises(ValueError, match="a topic that this node itself publishes") if own else nullcontext():
            configure(values | {"zernike_topic": topic}, lambda name: name if name[0] == "/" else f"/left/{name}")
