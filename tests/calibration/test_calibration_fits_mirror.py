"""The node that publishes a calibration and the one that uses it agree on whether it belongs to the mirror."""

from __future__ import annotations

import pytest

import focus_bench
from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import mirror_from
from dm_common.mirror import APERTURE_TOLERANCE, mismatch
from dm_controller.focus_parameters import PARAMETERS
from dm_controller.planning.active_calibration import active_calibration


@pytest.mark.parametrize("tolerance", [0.0, 0.05])
@pytest.mark.parametrize("share", [0.0, 0.015, -0.015, 0.025, 0.06])
def test_both_nodes_judge_alike(share: float, tolerance: float) -> None:
    """By the tolerance of the node that publishes; 0 = a message that does not say it."""
    info = focus_bench.mirror_info()
    calibration = focus_bench.calibration(radius=0.5 * info.working_aperture_diameter * (1 + share))
    calibration.aperture_tolerance = tolerance
    of = calibration.mirror_serial, calibration.actuators, calibration.aperture_radius
    fits = abs(share) < (tolerance or APERTURE_TOLERANCE)
    assert (mismatch(mirror_from(info), *of, tolerance or APERTURE_TOLERANCE) == "") is fits
    if fits:
        active_calibration(calibration, info)
    else:
        with pytest.raises(Refusal, match="aperture radius") as caught:
            active_calibration(calibration, info)
        assert caught.value.error_code == ErrorCode.CALIBRATION_MISMATCH


def test_the_tolerance_is_a_parameter_of_one_node() -> None:
    assert "aperture_tolerance" not in {parameter.name for parameter in PARAMETERS}
