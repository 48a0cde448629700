"""A mirror for benchmarks: an analytic plate under a hexagon of actuators with hysteresis, and its calibration.

The hysteresis models are identified as in a calibration, but from the displacements of the simulated actuators
projected by a random matrix, so that no maps have to be made.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from dm_msgs.msg import Calibration, Capabilities, MirrorInfo

from dm_calibration.calibration_messages import hysteresis_message
from dm_calibration.hysteresis.candidate_fit import CANDIDATES
from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.hysteresis.identify import identify
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run
from dm_common import Floats
from dm_common.geometry import hexagonal_positions, neighbour_pairs, ring_count
from dm_common.hysteresis.model import HysteresisModel
from dm_common.limits import Limits
from dm_common.messages import doubles, mirror_info_of
from dm_common.mirror import Mirror
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import TERMS, basis
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.planning.planner import HysteresisFigures
from dm_simulation.mirror.piezo import PiezoActuators, PiezoConfig
from studies.benchmarks.jobs.bounded_solve import PITCH, STROKE
from studies.solvers.plate_model import PlateProperties, plate_influence

#: Hysteresis law of the simulated actuators, by the class of the law that is fitted.
SIMULATED_LAWS = {
    "Prandtl-Ishlinskii": "prandtl_ishlinskii",
    "Preisach": "preisach",
    "Preisach and Duhem": "bouc_wen",
}
MAPS = 120
#: Actuators of the run, and number of values measured per map.
ACTUATORS, NUMBERS = 7, 12
SIGMA = 3e-10  # m, of a coefficient
WORKING_RADIUS = 11e-3  # m, of 37 actuators
SLEW_RATE = 40.0  # 1/s
SERIAL = "bench"


@cache
def identified_law(name: str) -> HysteresisModel:
    """The law of class `name` (of SIMULATED_LAWS), fitted to simulated actuators that follow a law of this kind."""
    x, y = hexagonal_positions(ACTUATORS, PITCH)
    mirror = Mirror("hexagon", "", x, y, WORKING_RADIUS, Limits(pairs=neighbour_pairs(x, y)))
    generator = np.random.default_rng(ACTUATORS)
    piezo = PiezoActuators(PiezoConfig(law=SIMULATED_LAWS[name]), generator, np.zeros(ACTUATORS))
    commands = excitation(mirror, MAPS)
    mixing = generator.standard_normal((ACTUATORS, NUMBERS)) / 4.0
    time = np.cumsum(1.0 + commands.dwell)
    values = np.empty((MAPS, NUMBERS))
    before = 0.0
    for row, (signals, seen) in enumerate(zip(commands.signals, time, strict=True)):
        piezo.apply(signals, before)
        piezo.advance(float(seen))
        values[row], before = piezo.displacement @ mixing, float(seen)
    values += SIGMA * generator.standard_normal(values.shape)
    responses = Responses(values, NUMBERS, np.ones(MAPS, dtype=bool))
    candidate = next(one for one in CANDIDATES if one.name == name)
    return identify(Run(commands.signals, time, responses, 0.0), candidates=(candidate,), folds=2).fit.law


def figures(law: HysteresisModel) -> HysteresisFigures:
    """The figures that a calibration would give for `law`."""
    return HysteresisFigures(law, 1e-9, 0.05)


def influence_model(actuators: int = 37) -> InfluenceModel:
    """The plate's influence function over an aperture that grows with the hexagon.

    Raises:
        ValueError: no full hexagon has that number of actuators.
    """
    positions = np.column_stack(hexagonal_positions(actuators, PITCH))
    radius = WORKING_RADIUS * ring_count(actuators) / 3
    points = edge_clustered_points(max(500, 2 * actuators))
    sag = STROKE * plate_influence(radius * np.column_stack([points.x, points.y]), positions, PlateProperties())
    weights = np.sqrt(points.weight)[:, None]
    terms: Floats = np.linalg.lstsq(weights * basis(points.x, points.y), weights * sag, rcond=None)[0].astype(float)
    return InfluenceModel(
        aperture_radius=radius,
        influence_zernike=terms,
        zernike_offset=np.zeros(len(TERMS)),
        points=points,
        influence_sag=sag,
        sag_offset=np.zeros(len(sag)),
        held_out_rms=2e-10,
        held_out_max_zernike=SIGMA,
    )


def mirror_info() -> MirrorInfo:
    """The mirror as the driver announces it."""
    x, y = hexagonal_positions(37, PITCH)
    mirror = Mirror("PDM30-37", SERIAL, x, y, WORKING_RADIUS, Limits(pairs=neighbour_pairs(x, y)))
    return mirror_info_of(mirror, full_aperture_diameter=0.03, slew_rate_max=SLEW_RATE)


def calibration(name: str, serial: str = SERIAL) -> Calibration:
    """A calibration of that mirror whose hysteresis is of the class `name` (of SIMULATED_LAWS)."""
    model, law = influence_model(), identified_law(name)
    known = figures(law)
    hysteresis = HysteresisFit(
        name, law, np.full(len(TERMS), SIGMA), known.held_out_max_zernike, known.unknown_sigma, MAPS, ()
    )
    return Calibration(
        id=SERIAL,
        mirror_serial=serial,
        aperture_radius=model.aperture_radius,
        actuators=37,
        influence_zernike=doubles(model.influence_zernike.ravel()),
        zernike_offset=doubles(model.zernike_offset),
        sample_x=doubles(model.points.x),
        sample_y=doubles(model.points.y),
        sample_weight=doubles(model.points.weight),
        influence_sag=doubles(model.influence_sag.ravel()),
        sag_offset=doubles(model.sag_offset),
        held_out_rms=model.held_out_rms,
        held_out_max_zernike=model.held_out_max_zernike,
        maps_used=MAPS,
        quality=Capabilities.CALIBRATED,
        hysteresis=hysteresis_message(hysteresis),
    )
