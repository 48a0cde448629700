"""Volts that the driver cannot know are not told, and nothing takes what stands in their place for a change."""

from __future__ import annotations

import json
import math

import numpy as np
from builtin_interfaces.msg import Time

from dm_calibration.calibration_messages import driver_facts
from dm_driver.commands.mirror_hold import MirrorHold
from dm_driver.driver_configuration import build_configuration
from dm_driver.driver_messages import mirror_info_message, state_message
from dm_driver.driver_parameters import PARAMETERS
from dm_driver.moves import WriterState


def test_the_numbers_of_a_device_server_are_no_volts() -> None:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    values |= {"mirror.serial": "1", "mirror.wiring": "custom", "mirror.channels": list(range(37))}
    values |= {"electronics.kind": "microscope", "electronics.address": "PYRO:Mirror@127.0.0.1:8000"}
    values |= {"volts.dac_at_zero": 0.0, "volts.dac_at_full": 1.0, "volts.amplifier_gain": 1.0}
    values |= {"volts.min": 0.0, "volts.max": 1.0}
    configuration = build_configuration(values)
    applied, numbers = configuration.output.outcome(configuration.output.codes(np.zeros(37)))
    written = WriterState(True, True, None, applied, applied, numbers, 0, 1, True, 0, 0, None, "")
    state = state_message(written, None, configuration, "mirror", MirrorHold(lambda: 0.0))
    assert len(state.applied) == 37 and not state.volts
    info = mirror_info_message(values, configuration, "mirror", Time())
    assert math.isnan(info.volts_min) and math.isnan(info.volts_max)
    facts = driver_facts(info)
    assert json.loads(json.dumps(facts)) == facts  # what an interrupted run is known again by
