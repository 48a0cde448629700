"""Actuators that did not follow their commands in some maps of a run, as an intermittent contact leaves them."""

from collections import defaultdict

from dm_calibration.calibration import Calibration
from dm_calibration.hysteresis.hysteresis_fit import effective_maps
from dm_calibration.recalibration.displaced import failed
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.drift_filter import DriftFilter
from dm_common.measurement import Measurement

#: What each sentence says of its actuator.
NOT_FOLLOWED = "did not follow its command"
#: Fewest maps that must show the same actuator elsewhere.
MAPS_MIN = 2


def not_followed(calibration: Calibration) -> list[str]:
    """A sentence for each actuator that alone explains several maps left out as outliers; none without hysteresis."""
    maps = calibration.maps
    outliers = [row for row, reason in enumerate(calibration.fit.reasons) if reason.startswith("outlier")]
    if calibration.hysteresis is None or not outliers:
        return []
    compared = DriftFilter(calibration, UpdateOptions())
    start = compared.start(calibration.stamp_ns)
    effective = effective_maps(maps, calibration.hysteresis.law).applied
    shown = defaultdict[int, list[str]](list)
    for row in outliers:
        seen = Measurement(
            points=maps.points,
            sag=maps.sag[row],
            coefficients=maps.coefficients[row],
            sigma=maps.sigma[row],
            stamp_ns=calibration.stamp_ns,
            residual_rms=float(maps.residual_rms[row]),
            valid_fraction=float(maps.valid_fraction[row]),
        )
        displaced = compared.compare(start, seen, effective[row]).displaced
        if len(displaced) == 1 and all(map(failed, displaced.values())):
            shown[next(iter(displaced))].append(maps.label[row])
    return [
        f"Actuator {actuator + 1} {NOT_FOLLOWED} in {len(labels)} of the {len(outliers)} maps left out as "
        f"outliers ({', '.join(labels[:5])}{' ...' if len(labels) > 5 else ''}): is its contact intermittent?"
        for actuator, labels in sorted(shown.items())
        if len(labels) >= MAPS_MIN
    ]
