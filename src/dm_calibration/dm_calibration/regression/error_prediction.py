"""Services `fit_regression` and `predict_error` of the node `calibration`."""

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_manager import CalibrationManager
from dm_calibration.calibration_parameters import fit_options
from dm_calibration.influence.fit import fit_influence
from dm_calibration.regression.predictor import ErrorPredictor, fit_predictor
from dm_calibration.regression.stepwise import P_ENTER, P_REMOVE, SelectionOptions
from dm_common.errors import ErrorCode, Refusal, error_code
from dm_common.messages import doubles
from dm_common.values import fill_with_nan, reals


class ErrorPrediction:
    """The regression in use. Both services may run in threads of their own.

    A regression belongs to one calibration. After a change of calibration, the next prediction fits a default one.
    """

    def __init__(self, manager: CalibrationManager, values: Mapping[str, Any]) -> None:
        """`values` are the parameters of the node."""
        self._manager, self._values = manager, values
        self._lock = threading.Lock()
        self._of = ""
        self._predictor: ErrorPredictor | Refusal | None = None  # Refusal: why none can be fitted

    def fit(self, request: Any, response: Any) -> Any:
        """Serve `fit_regression`.

        Raises:
            Refusal, ValueError, StoreError: see :mod:`~dm_common.errors`; nothing has changed then.
        """
        stored = self._manager.named(request.calibration)
        options = _selection(request.p_enter, request.p_remove)
        with self._lock:
            predictor = self._fitted(stored, request.method or stored.fit.method, options)
            self._of, self._predictor = stored.id, predictor
        fit, samples = predictor.fit, int(predictor.fit.result.nobs)
        response.adjusted_r2, response.f_statistic, response.p_value = fit.adjusted_r2, fit.f_statistic, fit.p_value
        response.samples = samples
        response.variables = list(fit.variables)
        response.parameters = doubles(fit.result.params)
        response.held_out_rms = predictor.held_out_rms
        response.message = (
            f"{predictor.influence.method} on {samples} surfaces of {stored.id}: {len(fit.variables)} variables, "
            f"held-out error {predictor.held_out_rms * 1e9:.1f} nm rms; R^2 and p are optimistic after selection"
        )
        return response

    def predict(self, request: Any, response: Any) -> Any:
        """Serve `predict_error`.

        Raises:
            Refusal, ValueError: see :mod:`~dm_common.errors`.
        """
        calibration = self._manager.named()
        mirror = self._manager.mirror
        low, high = (mirror.limits.low, mirror.limits.high) if mirror else (-1.0, 1.0)
        signals = np.array(request.signals, dtype=np.float64)
        reals([], low, high, sizes=(calibration.fit.actuators,)).check("signals", signals)
        with self._lock:
            if self._predictor is None or self._of != calibration.id:
                try:
                    self._predictor = self._fitted(calibration, calibration.fit.method, None)
                except Refusal as error:
                    self._predictor = error
                self._of = calibration.id
            predictor = self._predictor
        if isinstance(predictor, Refusal):
            if predictor.error_code != ErrorCode.TOO_FEW_MAPS:
                raise Refusal(predictor.error_code, str(predictor))
            # E.g. a calibration of pokes alone. No warning, since the controller requests this of every calibration.
            response.error_code, response.message = predictor.error_code, str(predictor)
            return fill_with_nan(response)
        response.predicted_rms, response.lower, response.upper = predictor.predict(signals)
        method = predictor.influence.method
        response.message = f"by {method} on calibration {calibration.id}, over many histories before this command"
        return response

    def _fitted(self, stored: Calibration, method: str, options: SelectionOptions | None) -> ErrorPredictor:
        influence = stored.fit
        try:
            if method != influence.method:
                left_out = [label for label, used in zip(stored.maps.label, influence.used, strict=True) if not used]
                influence = fit_influence(stored.maps, fit_options(self._values, method), exclude=left_out)
            return fit_predictor(stored.maps, influence, options)
        except ValueError as error:
            raise Refusal(error_code(error), f"calibration {stored.id}: {error}") from error


def _selection(p_enter: float, p_remove: float) -> SelectionOptions | None:
    """Thresholds of a request, 0 = default; None when both are. Raises Refusal when they contradict each other."""
    if p_enter == 0.0 and p_remove == 0.0:
        return None
    # If p_remove is invalid, the message must name it, not the p_enter that follows from it.
    enter = p_enter or (min(P_ENTER, p_remove) if p_remove > 0.0 else P_ENTER)
    try:
        return SelectionOptions(enter, p_remove or max(P_REMOVE, enter))
    except ValueError as error:
        raise Refusal(ErrorCode.OUT_OF_RANGE, str(error)) from error
