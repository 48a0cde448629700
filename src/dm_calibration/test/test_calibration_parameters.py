"""Parameters of the node `calibration` and the options they become."""

from __future__ import annotations

from typing import Any

import pytest

from dm_calibration.calibration_parameters import PARAMETERS, fit_options
from dm_calibration.influence.fit import FitOptions
from dm_common.ros.parameters import ParameterError

DEFAULTS: dict[str, Any] = {parameter.name: parameter.default for parameter in PARAMETERS}


def test_epsilon_is_that_of_the_fit_and_0_leaves_it_to_cross_validation() -> None:
    assert fit_options(DEFAULTS, "AZWreg").epsilon is None
    options = fit_options({**DEFAULTS, "epsilon": 4e-18}, "AZWreg")
    assert (options.method, options.epsilon) == ("AZWreg", 4e-18)


@pytest.mark.parametrize("value", [-1e-18, 1.0, float("nan")])
def test_an_epsilon_out_of_range_is_refused(value: float) -> None:
    parameter = next(parameter for parameter in PARAMETERS if parameter.name == "epsilon")
    with pytest.raises(ParameterError, match=r"epsilon = .*: must be float, 0 to 1e-06 m\^2"):
        parameter.check(value)


def test_options_of_a_fit_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="folds = 1: must be at least 2"):
        FitOptions(folds=1)
