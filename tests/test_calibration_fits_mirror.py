"""The node that publishes a calibration and the one that uses it agree on whether it belongs to the mirror."""

from __future__ import annotations

import pytest

import focus_bench
from dm_calibration.calibration_parameters import PARAMETERS as CALIBRATION_PARAMETERS
from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import mirror_from
from dm_common.mirror import mismatch
from dm_controller.focus_parameters import PARAMETERS as FOCUS_PARAMETERS
from dm_controller.planning.active_calibration import active_calibration


@pytest.mark.parametrize(("share", "fits"), [(0.0, True), (0.015, True), (-0.015, True), (0.025, False)])
def test_both_nodes_judge_alike(share: float, fits: bool) -> None:
    publishes, uses = (
        next(float(parameter.default) for parameter in parameters if parameter.name == "aperture_tolerance")
        for parameters in (CALIBRATION_PARAMETERS, FOCUS_PARAMETERS)
    )
    info = focus_bench.mirror_info()
    calibration = focus_bench.calibration(radius=0.5 * info.working_aperture_diameter * (1 + share))
    of = calibration.mirror_serial, calibration.actuators, calibration.aperture_radius
    assert (mismatch(mirror_from(info), *of, publishes) == "") is fits
    if fits:
        active_calibration(calibration, info, uses)
    else:
        with pytest.raises(Refusal, match="aperture radius") as caught:
            active_calibration(calibration, info, uses)
        assert caught.value.error_code == ErrorCode.CALIBRATION_MISMATCH
