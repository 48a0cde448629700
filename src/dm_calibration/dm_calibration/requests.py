"""Allowed values of the fields of requests and goals to the node `calibration`."""

from dm_calibration.hysteresis.excitation import MAPS_MAX, MAPS_MIN
from dm_calibration.influence.fit import METHODS
from dm_calibration.procedure.plan import PlanKind
from dm_common.limits import DEGAUSS_STEPS_MAX, DEGAUSS_STEPS_MIN
from dm_common.optics.zernike import TERMS
from dm_common.values import Fields, real, reals, text, texts, whole

_CONFIGURED = "as configured"
#: An id or a file name in the store.
_CALIBRATION = {"calibration": text("")}
_METHOD = {"method": text("", choices=("", *METHODS))}

CALIBRATE = Fields(
    {
        "plan": text("", choices=("", *PlanKind)),
        "surfaces": texts([], sizes=range(1001)),
        "poke_amplitude": real(0.0, 0.01, 1.0, zero=_CONFIGURED),
        "reference_every": whole(0, 1, 1000, zero=_CONFIGURED),
        "settle_time": real(0.0, 0.0, 600.0, "s", zero=_CONFIGURED),
        "maps_per_state": whole(0, 1, 100, zero="1"),
        "hysteresis_maps": whole(0, MAPS_MIN, MAPS_MAX, zero=_CONFIGURED),
        "until": real(0.0, 1e-12, 1e-3, "m", zero="the whole plan"),
        "note": text(""),
        "holder": text(""),
    }
)
LOAD_CALIBRATION = Fields(_CALIBRATION)
FIT_INFLUENCE_FUNCTION = Fields(_CALIBRATION | _METHOD | {"exclude": texts([])})
FIT_REGRESSION = Fields(
    _CALIBRATION
    | _METHOD
    | {"p_enter": real(0.0, 0.0, 1.0, zero="the default"), "p_remove": real(0.0, 0.0, 1.0, zero="the default")}
)
UPDATE_CALIBRATION = Fields({"holder": text("")})
STORE_RECIPES = Fields(
    {
        "recipes.calibration_id": text(""),
        "recipes.degauss_steps": whole(0, DEGAUSS_STEPS_MIN, DEGAUSS_STEPS_MAX),
        "recipes.interpolation_error": real(0.0, 0.0, 1.0, "m"),
    }
)
#: Fields of each recipe; the number of signals is checked against the calibration.
RECIPE = Fields(
    {
        "curvature": real(0.0),
        "conic_constant": real(0.0),
        "zernike": reals([], sizes=(0, len(TERMS))),
        "effective": reals([]),
        "signals": reals([], -1.0, 1.0),
        "by_model": reals([]),
        "max_zernike": real(0.0, 0.0, 1.0, "m"),
        "rms": real(0.0, 0.0, 1.0, "m"),
    }
)
