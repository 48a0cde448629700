"""A membrane that electrodes pull, from its configuration file alone: driver, wire, maps, calibration and plans.

In one process and by hand-made time: what runs between processes is the same for every mirror.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from dm_msgs.msg import MirrorInfo

from dm_bringup.nodes import NODES
from dm_bringup.suite import load_config
from dm_calibration import calibrate
from dm_calibration.acquisition.ingest import IngestSettings
from dm_calibration.calibration import POKE_CHECK, Calibration
from dm_calibration.calibration_messages import calibration_message
from dm_calibration.hysteresis.excitation import excitation
from dm_common import Floats
from dm_common.messages import mirror_from
from dm_controller.planning.active_calibration import ActiveCalibration, active_calibration
from dm_controller.planning.target import FocusTarget
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.driver_configuration import DriverConfiguration, build_configuration
from dm_driver.driver_messages import mirror_info_message
from dm_driver.moves import Outcome
from dm_simulation.bench import VirtualBench
from dm_simulation.parameters import bench_config
from dm_tools.verbs.up import shared_config
from dm_tools.verify import surface_error

pytestmark = pytest.mark.slow

SEED, PIXELS, MAPS = 2037, 120, 100
WAVELENGTH = 632.8e-9


@dataclass
class Chain:
    """Driver and bench with what lies between them.

    Attributes:
        bench: the virtual bench.
        configuration: the driver's.
        writer: the driver's.
        info: mirror_info.
        now: s, time of the bench.
    """

    bench: VirtualBench
    configuration: DriverConfiguration
    writer: ActuatorWriter
    info: MirrorInfo
    now: float = 0.0

    def go(self, signals: Floats) -> Floats:
        """Command a shape (N,) and wait until it stands; returns what the driver says was applied."""
        move = self.writer.command(self.configuration.limiter.check_shape(signals))
        assert move.wait(10.0) is Outcome.REACHED
        applied = self.writer.state().applied
        assert applied is not None
        deadline = time.monotonic() + 5.0
        while np.abs(self.bench.electronics.run(self.bench.unit.signals) - applied).max() > 1e-9:
            assert time.monotonic() < deadline, "what the driver says was applied does not stand at the electrodes"
            time.sleep(1e-3)
        return applied

    def map(self) -> Floats:
        """(height, width) m."""
        return self.bench.interferometer.measure(self.bench.displacement())

    def error(self, target: FocusTarget) -> float:
        """m, largest coefficient error of the true surface."""
        sag = self.bench.interferometer.true_sag(self.bench.displacement())
        middle = (PIXELS - 1) / 2
        info = SimpleNamespace(
            aperture_radius=self.info.working_aperture_diameter / 2,
            aperture_radius_px=PIXELS / 2,
            centre_x=middle,
            centre_y=middle,
        )
        return surface_error(sag, info, target).max_zernike


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    config = load_config(shared_config("membrane_37.yaml"))
    values = {
        node.name: {parameter.name: parameter.default for parameter in node.load_parameters()} | config[node.name]
        for node in NODES[:2]
    }
    bench_values, driver_values = values["virtual_bench"], values["pdm_driver"]
    bench_values |= {"seed": SEED, "electronics.tcp_port": 0, "trigger.port": -1, "interferometer.pixels": PIXELS}
    bench_values["output_folder"] = str(tmp_path_factory.mktemp("maps"))
    made: list[Chain] = []
    bench = VirtualBench(bench_config(bench_values), lambda: made[0].now if made else 0.0)
    driver_values |= {"electronics.port": bench.endpoints["tcp_port"], "limits.slew_rate": 1e4}
    configuration = build_configuration(driver_values)
    writer = ActuatorWriter(
        configuration.electronics, configuration.output, configuration.limiter, configuration.safe_shape
    )
    writer.start()
    assert writer.wait_for_link(10.0) and writer.enable(10.0)
    made.append(
        Chain(bench, configuration, writer, mirror_info_message(driver_values, configuration, "mirror", Time()))
    )
    yield made[0]
    writer.disable(5.0)
    writer.stop()
    bench.close()


@pytest.fixture(scope="module")
def calibration(chain: Chain) -> Calibration:
    """From maps of random shapes; the mount warms up meanwhile."""
    mirror = mirror_from(chain.info)
    commands = excitation(mirror, MAPS)
    applied, maps, times = [], [], []
    for signals, dwell in zip(commands.signals, commands.dwell, strict=True):
        applied.append(chain.go(signals))
        chain.now += 2.0 + float(dwell)
        maps.append(chain.map())
        times.append(chain.now)
    settings = IngestSettings(pitch=chain.bench.interferometer.pitch, aperture_radius=mirror.working_radius)
    return calibrate(np.array(maps), applied, times, mirror=mirror, settings=settings, hysteresis=True)


@pytest.fixture(scope="module")
def active(chain: Chain, calibration: Calibration) -> ActiveCalibration:
    return active_calibration(calibration_message(calibration, None, "mirror", WAVELENGTH / 20), chain.info)


def test_equal_signals_are_equal_pulls(chain: Chain) -> None:
    """Signals -1, 0 and +1 of all electrodes: nothing, half of it, all of it; the driver tells the volts."""
    centre = []
    for signal, volts in ((-1.0, 0.0), (0.0, 212.1), (1.0, 300.0)):
        chain.go(np.full(37, signal))
        state = chain.writer.state()
        assert state.volts is not None
        np.testing.assert_allclose(state.volts, volts, atol=0.1)
        centre.append(float(np.nanmin(chain.bench.interferometer.true_sag(chain.bench.displacement()))))
    assert centre[0] > centre[1] > centre[2]
    assert (centre[1] - centre[2]) / (centre[0] - centre[1]) == pytest.approx(1.13, abs=0.03)  # the gap narrows
    record = chain.bench.monitor.record
    assert record.violations == 0 and record.largest_jump <= 0.1 + 1e-3


def test_no_history_is_found(calibration: Calibration) -> None:
    known = calibration.hysteresis
    assert known is not None
    assert known.name in ("linear", "static", "static, each actuator its own")
    assert not known.law.has_history
    assert known.unknown_sigma == 0.0


def test_the_poke_check_finds_nothing(calibration: Calibration) -> None:
    """That a rising signal lowers the surface is right: electrodes pull."""
    assert not [text for text in calibration.limitations if text.startswith(POKE_CHECK)]


def test_spheres_over_the_range_that_is_told(chain: Chain, active: ActiveCalibration) -> None:
    """What is only pulled is hollow, but for what electrodes beyond the aperture do."""
    low, high = active.reachable_range(FocusTarget(0.0), 2e-8)
    assert -0.02 < low < 0.03 and 0.12 < high < 0.25
    rng = np.random.default_rng(SEED)
    errors, bounds = [], []
    for share in rng.uniform(0.02, 0.98, 30):
        target = FocusTarget(low + share * (high - low))
        move = active.planner.plan(target, None, chain.now)
        chain.go(move.signals)
        chain.now += 2.0
        errors.append(chain.error(target))
        bounds.append(move.plan.max_zernike_upper)
        chain.go(rng.uniform(-1.0, 1.0, 37))  # no history
    # At the ends of the range the gap is narrower everywhere, which no law of single electrodes holds.
    assert np.median(errors) < WAVELENGTH / 100
    assert np.quantile(errors, 0.9) < WAVELENGTH / 30
    assert np.max(errors) < 4.0 * np.median(bounds)
