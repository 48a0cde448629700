"""Services `fit_regression` and `predict_error` of the node `calibration`, and the controller's use of them."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import Calibration as CalibrationMsg
from dm_msgs.msg import ErrorCode, MirrorInfo
from dm_msgs.srv import FitInfluenceFunction, FitRegression, LoadCalibration, PredictError
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter as RosParameter

from dm_calibration.calibration import Calibration
from dm_calibration.influence.fit import InfluenceFit, fit_influence
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.weights import surface_control_error
from dm_calibration.regression import error_prediction
from dm_calibration.regression.predictor import fit_predictor
from dm_calibration.regression.surface_error import SURFACES
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common.errors import NO_CALIBRATION
from dm_common.limits import Limits
from dm_common.messages import mirror_info_of
from dm_common.optics.zernike import basis
from dm_common.ros import qos
from dm_common.ros.worker import WorkerService
from dm_controller.forecast import ForecastClient, HysteresisShare, surface_control_error_rms
from dm_controller.planning.mirror_model import CalibratedMirror
from hysteretic_mirror import MIRROR, calibrated, calibrated_by_pokes
from linear_mirror import RADIUS
from studies.comparison.simulated_bench import influence_model
from support import NodeProcess, Observer, wait_until


def doubles(values: np.ndarray) -> array[float]:
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def stored(identifier: str, maps: MapSet, fit: InfluenceFit, created_ns: int) -> Calibration:
    return Calibration(
        id=identifier,
        mirror_name=MIRROR.name,
        mirror_serial=MIRROR.serial,
        wavelength=632.8e-9,
        aperture_radius=RADIUS,
        created_ns=created_ns,
        actuator_x=MIRROR.x,
        actuator_y=MIRROR.y,
        maps=maps,
        fit=fit,
    )


def unfit() -> Iterator[Calibration]:
    """Calibrations whose maps do not do for a regression, by name."""
    maps, fit = calibrated()
    number = np.array([int(label[1:]) if label in SURFACES else 0 for label in maps.label])
    for name, kept in (("few", number < 10), ("levels", (number < 6) | (number > 45) & (number < 55))):
        chosen = maps.select(kept)
        yield stored(name, chosen, fit_influence(chosen, rings=MIRROR.rings), 1)
    sag = maps.sag.copy()
    sag[maps.label.index("p44"), np.hypot(maps.points.x, maps.points.y) < 0.35] = np.nan
    yield stored("holed", replace(maps, sag=sag), fit, 1)
    coefficients = maps.applied @ fit.influence_zernike.T
    same = coefficients @ basis(maps.points.x, maps.points.y).T + 40e-9 * np.cos(9.0 * maps.points.x)
    yield stored("same", replace(maps, sag=same, coefficients=coefficients), fit, 1)


#: What is wrong with each of them, as the node says it.
UNFIT = {
    "pokes": (ErrorCode.TOO_FEW_MAPS, "calibrate with the plan full"),
    "few": (ErrorCode.TOO_FEW_MAPS, "9 samples: a constant, one variable and 10 degrees of freedom"),
    "levels": (ErrorCode.TOO_FEW_MAPS, "candidates s02 and s03 are proportional over all samples"),
    "holed": (ErrorCode.MAP_INSUFFICIENT, "p44: the concentric region of 10% of the area holds no valid data"),
    "same": (ErrorCode.INVALID_ARGUMENT, "the response is the same for all samples"),
}


@pytest.fixture
def node(start: Callable[..., NodeProcess], observer: Observer, tmp_path: Path) -> NodeProcess:
    store = CalibrationStore(tmp_path / "calibrations")
    store.save(stored("pokes", *calibrated_by_pokes(), 1))
    store.save(stored("whole", *calibrated(), 2))
    for calibration in unfit():
        store.save(calibration)
    process = start("dm_calibration", "calibration", {"calibration_folder": str(store.folder), "write_report": False})
    publisher = observer.node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
    publisher.publish(mirror_info_of(MIRROR))
    return process


def load(observer: Observer, name: str) -> None:
    def loaded() -> bool:
        answer = observer.call(LoadCalibration, "load_calibration", LoadCalibration.Request(calibration=name))
        return bool(answer.error_code == ErrorCode.OK)

    wait_until(loaded, 60, f"{name} loaded")


def test_fit_and_predict(node: NodeProcess, observer: Observer) -> None:
    def fit(**fields: Any) -> Any:
        return observer.call(FitRegression, "fit_regression", FitRegression.Request(**fields), 30)

    def predict(signals: np.ndarray) -> Any:
        return observer.call(PredictError, "predict_error", PredictError.Request(signals=doubles(signals)), 30)

    refused = predict(np.zeros(37))
    assert refused.error_code == ErrorCode.NOT_CALIBRATED and NO_CALIBRATION in refused.message
    assert fit().error_code == ErrorCode.NOT_CALIBRATED

    load(observer, "whole")
    signals = np.full(37, -1.0)
    signals[11] = 1.0
    first = predict(signals)  # without a regression asked for before
    assert first.error_code == ErrorCode.OK, first.message
    assert 0.0 <= first.lower < first.predicted_rms < first.upper < 1e-6
    answer = fit()
    assert answer.error_code == ErrorCode.OK, answer.message
    assert answer.samples == 58 and answer.variables[0] == "model"
    assert len(answer.parameters) == len(answer.variables) + 1
    assert answer.adjusted_r2 > 0.9 and 0.0 < answer.held_out_rms < 20e-9 and answer.p_value < 1e-6
    assert "optimistic" in answer.message
    again = predict(signals)
    assert (again.predicted_rms, again.upper) == pytest.approx((first.predicted_rms, first.upper))

    weighted = fit(calibration="whole", method="AZWreg", p_enter=1e-6)
    assert weighted.error_code == ErrorCode.OK and weighted.message.startswith("AZWreg")
    changed = predict(signals)
    assert changed.error_code == ErrorCode.OK and "AZWreg" in changed.message
    assert changed.predicted_rms != first.predicted_rms

    for fields, code, words in (
        ({"method": "AZx"}, ErrorCode.UNKNOWN_NAME, "AZreg"),
        ({"calibration": "nothing"}, ErrorCode.UNKNOWN_NAME, "nothing"),
        ({"p_enter": 0.2, "p_remove": 0.1}, ErrorCode.OUT_OF_RANGE, "p_remove = 0.1: must be at least p_enter"),
        ({"p_enter": float("nan")}, ErrorCode.NOT_FINITE, "p_enter = nan"),
        ({"p_remove": -0.1}, ErrorCode.OUT_OF_RANGE, "p_remove = -0.1: must be float, 0 to 1"),
    ):
        wrong = fit(**fields)
        assert wrong.error_code == code and words in wrong.message, wrong.message
    assert predict(signals).predicted_rms == changed.predicted_rms  # refusals change nothing

    outside = signals.copy()
    outside[4] = 1.01
    for bad, code, words in (
        (signals[:-1], ErrorCode.INVALID_LENGTH, "signals has 36 values: must have 37"),
        (np.where(np.arange(37) == 2, np.nan, signals), ErrorCode.NOT_FINITE, "signals[2] = nan"),
        (outside, ErrorCode.OUT_OF_RANGE, "signals[4] = 1.01: must be float[], -1 to 1"),
    ):
        wrong = predict(bad)
        assert wrong.error_code == code and words in wrong.message, wrong.message

    assert "Traceback" not in node.output, node.output


def test_maps_that_do_not_do_are_refused_and_what_was_in_use_stays(node: NodeProcess, observer: Observer) -> None:
    published = observer.record(CalibrationMsg, "calibration", qos.LATCHED)
    signals = doubles(np.linspace(-0.5, 0.5, 37))

    def predict() -> Any:
        return observer.call(PredictError, "predict_error", PredictError.Request(signals=signals), 30)

    load(observer, "whole")
    before = predict()
    assert before.error_code == ErrorCode.OK, before.message
    for name, (code, words) in UNFIT.items():
        request = FitRegression.Request(calibration=name)
        refused = observer.call(FitRegression, "fit_regression", request, 30)
        assert (refused.error_code, words in refused.message) == (code, True), refused.message
        assert refused.message.startswith(f"calibration {name}: ")
    assert predict().predicted_rms == before.predicted_rms
    for name, code, words in (
        ("holed", ErrorCode.MAP_INSUFFICIENT, "p44: the concentric region of 10%"),
        ("same", ErrorCode.INVALID_ARGUMENT, "the regional errors are the same for all 69 sample surfaces"),
    ):
        fit = FitInfluenceFunction.Request(calibration=name, method="AZWreg", activate=True)
        refused = observer.call(FitInfluenceFunction, "fit_influence_function", fit, 30)
        assert (refused.error_code, words in refused.message) == (code, True), refused.message
    assert published[-1].id == "whole"

    for name, (code, words) in UNFIT.items():  # in use, there is an influence function but no prediction
        load(observer, name)
        refused = predict()
        assert (refused.error_code, words in refused.message) == (code, True), refused.message
    load(observer, "whole")
    assert predict().predicted_rms == before.predicted_rms
    assert "Traceback" not in node.output, node.output
    # The controller asks of each calibration, and a clean start warns of nothing.
    assert "predict_error: calibration pokes" not in node.output


def test_why_a_calibration_tells_no_error_is_found_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = list[str]()

    def fitted(*arguments: Any) -> Any:
        calls.append("fit_predictor")
        return fit_predictor(*arguments)

    monkeypatch.setattr(error_prediction, "fit_predictor", fitted)
    maps, fit = calibrated_by_pokes()
    calibration = stored("pokes", maps, fit, 1)
    manager: Any = SimpleNamespace(named=lambda: calibration, mirror=MIRROR)
    service = error_prediction.ErrorPrediction(manager, {})
    request = PredictError.Request(signals=doubles(np.zeros(37)))
    answers = [service.predict(request, PredictError.Response()) for _ in range(3)]
    assert [answer.error_code for answer in answers] == [ErrorCode.TOO_FEW_MAPS] * 3
    assert len({answer.message for answer in answers}) == 1 and calls == ["fit_predictor"]


def test_epsilon_is_a_parameter(node: NodeProcess, observer: Observer, tmp_path: Path) -> None:
    def set_epsilon(value: float) -> Any:
        request = SetParameters.Request(parameters=[RosParameter("epsilon", value=value).to_parameter_msg()])
        return observer.call(SetParameters, "calibration/set_parameters", request).results[0]

    load(observer, "whole")
    refused = set_epsilon(-1e-18)
    assert not refused.successful and "epsilon" in refused.reason
    assert set_epsilon(4e-16).successful
    request = FitInfluenceFunction.Request(method="AZWreg")
    fitted = observer.call(FitInfluenceFunction, "fit_influence_function", request, 30)
    assert fitted.error_code == ErrorCode.OK, fitted.message
    limitations = CalibrationStore(tmp_path / "calibrations").load(fitted.id).limitations
    assert any("epsilon 400 nm^2 given" in sentence for sentence in limitations), limitations


def without_hysteresis(identifier: str) -> Any:
    """A calibration in use that does not know the hysteresis itself."""
    model = influence_model(calibrated()[1], RADIUS)
    return SimpleNamespace(
        calibration=SimpleNamespace(id=identifier),
        planner=SimpleNamespace(hysteresis=None),
        mirror=CalibratedMirror(model, Limits(-1.0, 1.0, np.zeros((0, 2), dtype=np.intp), 2.0)),
        reachable_range=lambda target, tolerance: (-0.02, 0.02),
    )


def test_the_controller_gets_its_forecast_without_waiting(node: NodeProcess, observer: Observer) -> None:
    active = without_hysteresis("whole")
    client = ForecastClient(observer.node)
    assert client.share is None
    load(observer, "whole")

    def ready() -> bool:
        client.use(active, 2e-8)
        return client.share is not None

    wait_until(ready, 60, node.output)
    share = client.share
    assert share is not None
    lower, upper = share.interval(0.015, 5e-9)
    assert 5e-9 <= lower < upper < 1e-6
    assert share.interval(0.015, 50e-9)[1] == pytest.approx(np.sqrt(upper**2 - 25e-18 + 2500e-18))
    client.use(active, 2e-8)
    assert client.share is share
    client.use(None, 2e-8)
    assert client.share is None


def test_a_refusal_that_passes_does_not_end_the_forecast(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The calibration node may be inactive while its calibration is in use."""
    monkeypatch.setattr("dm_controller.forecast.RETRY_S", 0.2)
    codes = [ErrorCode.NODE_INACTIVE]

    def predict(_request: Any, response: Any) -> Any:
        response.error_code, response.message = codes[-1], "as the node is now"
        response.lower, response.upper = 1e-9, 2e-9
        return response

    WorkerService(observer.node, PredictError, "predict_error", predict)
    active = without_hysteresis("one")
    client = ForecastClient(observer.node)

    def refused() -> bool:
        client.use(active, 2e-8)
        return bool(client._last_message)

    def known() -> bool:
        client.use(active, 2e-8)
        return client.share is not None

    wait_until(refused, 30)
    codes.append(ErrorCode.OK)
    wait_until(known, 30)
    # Less than the surface model leaves: hysteresis has no share, and not the root of less than none.
    assert client.share is not None and np.isfinite(client.share.interval(0.0, 0.0)).all()


def test_share_of_the_hysteresis() -> None:
    share = HysteresisShare(np.array([0.0, 0.02]), 1e-18 * np.array([[0.0, 9.0], [1600.0, 2700.0]]))
    assert share.interval(0.02, 0.0) == pytest.approx((40e-9, np.sqrt(2700.0) * 1e-9))
    assert share.interval(0.0, 4e-9) == pytest.approx((4e-9, 5e-9))


def test_modelled_error_agrees_with_the_calibrations_own() -> None:
    maps, fit = calibrated()
    signals = maps.applied[maps.label.index("p44")]
    sag = fit.sag_offset + fit.influence_sag @ signals
    error = surface_control_error(sag[np.newaxis], signals[np.newaxis], fit.influence_zernike, fit.points)[0]
    expected = np.sqrt(np.sum(fit.points.weight * error**2))
    assert surface_control_error_rms(influence_model(fit, RADIUS), signals) == pytest.approx(expected)
