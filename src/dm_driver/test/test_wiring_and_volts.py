"""Wiring tables, and the way from signal to code."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import ActuatorState
from hypothesis import given, settings
from hypothesis import strategies as st

from dm_common.errors import ErrorCode
from dm_driver.commands.mirror_hold import MirrorHold
from dm_driver.driver_configuration import build_configuration
from dm_driver.driver_messages import state_message
from dm_driver.driver_parameters import PARAMETERS
from dm_driver.moves import Kind, WriterState
from dm_driver.output.volts import LAWS, VoltScale
from dm_driver.output.wiring import TABLES, OutputStage, wiring_table
from dm_driver.safety_limiter import DriverLimits, SafetyLimiter


@pytest.mark.parametrize("name", sorted(TABLES))
def test_named_tables_are_whole(name: str) -> None:
    table = wiring_table(name, [], 37, 40)
    assert len(set(table.tolist())) == 37
    assert {0, 20}.isdisjoint(table.tolist())
    assert table.min() >= 0 and table.max() < 40


def test_first_and_last_channels_of_the_tables() -> None:
    ends = {name: (table[0], table[1], table[-1]) for name, table in TABLES.items()}
    assert ends == {"trihex": (14, 16, 12), "37ch_30mm": (10, 13, 31), "37ch_30mm_v2005": (10, 4, 2)}


@pytest.mark.parametrize(
    ("name", "custom", "actuators", "text"),
    [
        ("hexagon", [], 37, "'hexagon': unknown; must be one of trihex, 37ch_30mm, 37ch_30mm_v2005, custom"),
        ("trihex", [], 19, "mirror.wiring = 'trihex' lists 37 channels: must be 19"),
        ("trihex", [1, 2], 37, "mirror.channels is given but mirror.wiring = 'trihex'"),
        ("custom", [1, 2, 3], 4, "mirror.channels lists 3 channels: must be 4"),
        ("custom", [1, 2, 40], 3, "actuator 3 on channel 40; must be -1 to 39"),
        ("custom", [1, -2, 4], 3, "actuator 2 on channel -2"),
        ("custom", [5, 2, 5], 3, "channel 5 by actuators 1, 3"),
        ("custom", [-1, -1], 2, "no actuator has a channel"),
    ],
)
def test_wrong_wirings_are_refused(name: str, custom: Sequence[int], actuators: int, text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        wiring_table(name, custom, actuators, 40)


def test_custom_wiring_with_an_unconnected_actuator() -> None:
    stage = OutputStage(VoltScale(65535, 0, 12, 25, 0, 300), wiring_table("custom", [3, -1, 0], 3, 40), 40)
    codes = stage.codes(np.array([1.0, 1.0, 0.0]))
    assert codes[3] == 65535 and codes[0] in (32767, 32768)
    assert np.delete(codes, [0, 3]).tolist() == [0] * 38
    assert np.flatnonzero(stage.wired).tolist() == [0, 3]
    signals, volts = stage.outcome(codes)
    assert signals == pytest.approx([1, -1, 0], abs=2e-5)
    assert volts == pytest.approx([300, 0, 150], abs=3e-3)
    # What it was asked for it never reaches, and where it rests is no limit of the signals.
    limiter = SafetyLimiter(DriverLimits(actuators=3, low=-0.5))
    configuration: Any = SimpleNamespace(output=stage, limiter=limiter, electronics=SimpleNamespace(knows_volts=True))
    wanted = np.array([0.5, 0.5, 0.0])
    moving = WriterState(True, True, Kind.COMMAND, wanted, signals, volts, 0, 1, True, 0, 0, None, "")
    state = state_message(moving, None, configuration, "mirror", MirrorHold(lambda: 0.0))
    on_its_way = ActuatorState.FLAG_RAMPING | ActuatorState.FLAG_AT_LIMIT
    assert list(state.flags) == [on_its_way, ActuatorState.FLAG_UNUSED, 0]
    lost = replace(moving, link_up=False, enabled=False, fault="no route")
    message = state_message(lost, None, configuration, "mirror", MirrorHold(lambda: 0.0))
    assert message.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
    assert message.message == "the driver is not active, and the drive electronics are unreachable: no route"


def test_channels_without_an_actuator_are_at_zero_volts() -> None:
    """They were at volts.min: at -200 V, where a bimorph mirror uses -200 to 400 V."""
    stage = OutputStage(VoltScale(65535, -6, 6, 80, -200, 400), wiring_table("custom", [3, -1, 0], 3, 40), 40)
    codes = stage.codes(np.array([1.0, 1.0, -1.0]))
    volts = stage.scale.volts_of_codes(codes)
    assert volts[[0, 3]] == pytest.approx([-200, 400], abs=0.015)  # a code is 0.0146 V
    assert np.delete(volts, [0, 3]) == pytest.approx(0, abs=0.01)
    assert stage.outcome(codes)[1] == pytest.approx([400, 0, -200], abs=0.015)


@pytest.mark.parametrize(
    ("low", "high", "law", "limits", "volts"),
    [
        (0.0, 300.0, "linear", (-1.0, 1.0), 0.0),
        (-200.0, 400.0, "linear", (-1.0, 1.0), 0.0),
        (-400.0, 400.0, "linear", (-1.0, 1.0), 0.0),
        (-400.0, -50.0, "linear", (-1.0, 1.0), -50.0),
        (50.0, 400.0, "linear", (-1.0, 1.0), 50.0),
        (-200.0, 400.0, "linear", (0.0, 1.0), 100.0),  # the nearest signal in limits.signal_min..signal_max
        (-200.0, 400.0, "linear", (-1.0, -0.5), -50.0),
        (0.0, 300.0, "square", (-1.0, 1.0), 0.0),
        (100.0, 300.0, "square", (-1.0, 1.0), 100.0),
    ],
)
def test_the_safe_shape_is_at_zero_volts(
    low: float, high: float, law: str, limits: tuple[float, float], volts: float
) -> None:
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    values |= {"mirror.serial": "1", "electronics.kind": "edac40_tcp", "electronics.address": "127.0.0.1"}
    values |= {"volts.dac_at_zero": -6.0, "volts.dac_at_full": 6.0, "volts.amplifier_gain": 80.0}
    values |= {"volts.min": low, "volts.max": high, "drive.law": law}
    values |= {"limits.signal_min": limits[0], "limits.signal_max": limits[1]}
    configuration = build_configuration(values)
    assert configuration.output.scale.volts(configuration.safe_shape) == pytest.approx([volts] * 37, abs=1e-9)
    own = build_configuration(values | {"safe_signals": [limits[1]] * 37})
    assert own.safe_shape.tolist() == [limits[1]] * 37


def test_vendor_rule_when_the_range_is_the_whole_dac() -> None:
    """code = max_code (u + 1) / 2, as in the vendor's library."""
    scale = VoltScale(4095, 0.0, 5.0, 60.0, 0.0, 300.0)
    signals = np.linspace(-1, 1, 4096)
    assert (scale.codes(signals) == np.arange(4096)).all()
    assert scale.resolution == pytest.approx(2 / 4095)


def test_edac40_as_delivered() -> None:
    """Code 0 is -6 V: 0 V at the actuator is mid scale, and 300 V needs 3.75 V at the DAC."""
    scale = VoltScale(65535, -6.0, 6.0, 80.0, 0.0, 300.0)
    codes = scale.codes(np.array([-1.0, 0.0, 1.0]))
    assert codes.tolist() == [32768, 43007, 53247]
    assert scale.volts_of_codes(codes) == pytest.approx([0, 150, 300], abs=0.015)
    assert (scale.volts_of_codes(codes) >= 0).all() and (scale.volts_of_codes(codes) <= 300).all()


def test_square_law() -> None:
    """Equal steps of the signal are equal steps of the volts squared, and what is applied is what the codes do."""
    scale = VoltScale(4095, 0.0, 5.0, 60.0, 0.0, 300.0, "square")
    signals = np.linspace(-1, 1, 9)
    assert scale.volts(signals) == pytest.approx(300.0 * np.sqrt(np.arange(9) / 8))
    stage = OutputStage(scale, np.arange(9), 40)
    codes = stage.codes(signals)
    assert codes[:9].tolist() == [0, 1448, 2048, 2508, 2896, 3237, 3546, 3831, 4095]
    assert codes[9:].tolist() == [0] * 31
    applied, volts = stage.outcome(codes)
    assert volts == pytest.approx(codes[:9] * (300.0 / 4095))
    assert applied == pytest.approx(2.0 * (codes[:9] / 4095) ** 2 - 1.0)
    assert np.abs(applied - signals).max() <= 0.5 * scale.resolution
    # Codes count most at the upper end, twice as much as with the linear law, and least at 0 V.
    assert scale.resolution == pytest.approx(4 / 4095)
    neighbours = scale.signals_of_codes(np.arange(4096, dtype=np.uint16))
    assert (np.diff(neighbours) <= scale.resolution).all() and np.diff(neighbours)[0] < 1e-6
    # A range that does not begin at 0 V.
    assert VoltScale(4095, 0.0, 5.0, 60.0, 100.0, 260.0, "square").volts(np.zeros(1)) == pytest.approx(
        np.sqrt((100**2 + 260**2) / 2)
    )


scales = st.builds(
    lambda law, bits, zero, span, inverted, gain, low, width: VoltScale(
        2**bits - 1,
        *((zero + span, zero) if inverted else (zero, zero + span)),
        gain,
        gain * (zero + span * low) if gain > 0 else gain * (zero + span * (low + width)),
        gain * (zero + span * (low + width)) if gain > 0 else gain * (zero + span * low),
        law if gain * zero >= 0.0 and gain * (zero + span) >= 0.0 else "linear",
    ),
    st.sampled_from(sorted(LAWS)),
    st.sampled_from([12, 14, 16]),
    st.floats(-10, 10),
    st.floats(1, 20),
    st.booleans(),
    st.floats(1, 200).flatmap(lambda gain: st.sampled_from([gain, -gain])),
    st.floats(0, 0.4),
    st.floats(0.1, 0.6),
)


@settings(max_examples=80, deadline=None)
@given(scales, st.lists(st.floats(-1, 1), min_size=1, max_size=8))
def test_quantisation_is_within_one_code_and_never_outside_the_range(scale: VoltScale, values: list[float]) -> None:
    signals = np.array([*values, -1.0, 1.0])
    codes = scale.codes(signals)
    back = scale.signals_of_codes(codes)
    assert (np.abs(back - signals) <= scale.resolution * (1 + 1e-6)).all()
    assert (np.abs(back) <= 1 + 1e-6 * scale.resolution * 10).all()
    assert scale.volts(back) == pytest.approx(scale.volts_of_codes(codes), abs=1e-6)  # a code is 10 uV or more


@pytest.mark.parametrize("bad", [math.nan, 1.0001, -1.0001, math.inf])
def test_codes_of_illegal_signals_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="must be finite and in -1 to 1"):
        VoltScale(4095, 0.0, 5.0, 60.0, 0.0, 300.0).codes(np.array([0.0, bad]))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((65535, -6, 6, 80, 0, 500), "volts.max = 500 V needs 6.25 V at the DAC, which reaches -6 to 6 V"),
        ((65535, 0, 6, 80, -10, 300), "volts.min = -10 V needs -0.125 V"),
        ((65535, -6, 6, 0, 0, 300), "volts.amplifier_gain = 0"),
        ((65535, 6, 6, 80, 0, 300), "volts.dac_at_zero = volts.dac_at_full"),
        ((65535, -6, 6, 80, 300, 0), "volts.max = 0 V: must be above volts.min = 300 V"),
        ((65535, -6, 6, 800000, 0, 300), "spans only 2 of 65535 codes"),
        ((65535, -6, 6, 80, -10, 300, "square"), "volts.min = -10 V: must be at least 0 with drive.law = 'square'"),
    ],
)
def test_contradictory_voltages_are_refused(arguments: tuple[Any, ...], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        VoltScale(*arguments)
