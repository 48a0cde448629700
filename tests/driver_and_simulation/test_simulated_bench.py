"""The bench in process: same maps as through files, same mirror as behind the sockets, honest copies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.map_files import read_map
from dm_calibration.procedure.plan import PlanKind
from dm_common.errors import Refusal
from dm_simulation.bench import BenchConfig, VirtualBench
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.zygo_files import encode_dat
from dm_simulation.mirror.piezo import PiezoActuators
from studies.comparison.simulated_bench import SimulatedBench, SimulationConfig, influence_model, plan_steps

SMALL = SimulationConfig(seed=7, pixels=120, degauss_steps=20)
WAVELENGTH = 632.8e-9
#: One count of a .dat file of the highest phase resolution.
COUNT = 0.5 * WAVELENGTH / 131072


@pytest.fixture(scope="module")
def bench() -> SimulatedBench:
    return SimulatedBench(SMALL)


def test_arrays_give_what_a_file_gives(bench: SimulatedBench, tmp_path: Path) -> None:
    fork = bench.fork()
    fork.apply(np.linspace(-0.5, 0.5, 37))
    fork.settle()
    sag = fork.take_map()
    path = tmp_path / "map.dat"
    path.write_bytes(encode_dat(sag, fork.pitch, WAVELENGTH, 1_700_000_000))
    np.testing.assert_allclose(read_map(path).sag, sag, atol=0.51 * COUNT)
    ours = fork.measurement_of(sag)
    surface, filed = Ingest(SMALL.samples).read(path, IngestSettings(aperture_radius=fork.mirror.working_radius))
    np.testing.assert_allclose(filed.coefficients, ours.coefficients, atol=COUNT)
    np.testing.assert_allclose(filed.sag, ours.sag, atol=COUNT)
    assert filed.valid_fraction == ours.valid_fraction
    assert filed.radius == pytest.approx(ours.radius, rel=1e-6)
    assert surface.wavelength == pytest.approx(ours.wavelength, rel=1e-6)


def test_a_seed_is_the_same_mirror_as_behind_the_sockets(bench: SimulatedBench) -> None:
    ports = PortsConfig(OFF, OFF, OFF, "")
    served = VirtualBench(BenchConfig(seed=SMALL.seed, ports=ports, trigger_port=OFF))
    try:
        assert isinstance(served.actuators, PiezoActuators)
        np.testing.assert_array_equal(0.5 * served.actuators.config.stroke * served.actuators.gain, bench.true_stroke)
        figure = served.interferometer.true_sag(np.zeros(37))
        flat = bench._interferometer.true_sag(np.zeros(37))
        # Both normalise the figure on their own pixels.
        assert np.nanstd(flat) == pytest.approx(np.nanstd(figure), rel=1e-6)
    finally:
        served.close()


def test_signals_stand_on_codes_of_the_dac(bench: SimulatedBench) -> None:
    fork = bench.fork()
    wanted = np.random.default_rng(1).uniform(-0.6, 0.6, 37)
    applied = fork.apply(wanted)
    step = 2 * 400.0 / 65535 / 300.0
    assert 0 < np.abs(applied - wanted).max() <= 0.5 * step
    np.testing.assert_allclose((applied + 1) / step, np.rint((applied + 1) / step), atol=1e-6)


def test_moves_take_the_time_of_the_slew_limit(bench: SimulatedBench) -> None:
    fork = bench.fork()
    fork.apply(np.zeros(37))
    before = fork.time
    fork.apply(np.full(37, 0.8))
    assert fork.time - before == pytest.approx(0.8 / 40.0)
    fork.settle()
    fork.measure("")
    assert fork.time - before == pytest.approx(0.8 / 40.0 + SMALL.settle_time + SMALL.exposure)


def test_forks_go_their_own_ways_from_the_same_state(bench: SimulatedBench) -> None:
    one, other = bench.fork(), bench.fork()
    np.testing.assert_array_equal(one.take_map(), other.take_map())
    one.apply(np.full(37, 0.5))
    one.apply(np.zeros(37))
    other.apply(np.zeros(37))
    assert np.nanmax(np.abs(one.true_map() - other.true_map())) > 10e-9  # what hysteresis remembers
    third = bench.fork()
    third.apply(np.zeros(37))
    np.testing.assert_array_equal(third.true_map(), other.true_map())


def test_a_degauss_wipes_the_hysteresis(bench: SimulatedBench) -> None:
    shapes = []
    for first in (-0.9, 0.9):
        fork = bench.fork()
        fork.apply(np.full(37, first))
        fork.degauss()
        fork.time += 1e7  # creep of the two histories differs until it has died away
        shapes.append(fork.true_map())
    assert np.nanmax(np.abs(shapes[0] - shapes[1])) < 2e-9


def test_illegal_signals_are_refused_and_move_nothing(bench: SimulatedBench) -> None:
    fork = bench.fork()
    before = fork.true_map()
    with pytest.raises(Refusal, match="must be -1 to 1"):
        fork.apply(np.full(37, 1.2))
    np.testing.assert_array_equal(fork.true_map(), before)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["none", "bouc_wen"])
def test_a_calibration_finds_the_true_influence(law: str) -> None:
    bench = SimulatedBench(
        SimulationConfig(law=law, seed=3, creep=0.0 if law == "none" else 0.01, pixels=120, degauss_steps=20)
    )
    steps: list[int] = []
    calibration = bench.calibrate(PlanKind.POKES, progress=lambda now: steps.append(now.done))
    assert len(steps) == plan_steps(PlanKind.POKES) + 1
    assert calibration.maps.points.x.size == 500
    model = influence_model(calibration.fit, calibration.aperture_radius)
    true, _ = bench.true_influence()
    rows, columns = np.nonzero(np.isfinite(bench.true_map()))
    aperture = bench.aperture
    sag = np.full((SMALL.pixels, SMALL.pixels), np.nan)
    errors = []
    for actuator in range(37):
        sag[rows, columns] = true[:, actuator] * bench.true_stroke[actuator]
        wanted = bench.measurement_of(sag).coefficients[3:]
        errors.append(np.linalg.norm(model.influence_zernike[3:, actuator] - wanted) / np.linalg.norm(wanted))
    assert aperture.radius_px == pytest.approx(SMALL.pixels / 2)
    # Without hysteresis only noise is left (a few 0.1 nm of some 500 nm); with it, pokes are steeper or flatter.
    assert max(errors) < (0.01 if law == "none" else 0.2)
    np.testing.assert_allclose(bench.apply(bench.mirror.rest), np.zeros(37), atol=1e-4)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"law": "magic"}, "piezo.law = 'magic'"),
        ({"pixels": 10}, "pixels = 10: must be at least 64"),
        ({"settle_time": -1.0}, "settle_time = -1.0 s: must not be negative"),
        ({"degauss_steps": 0}, "degauss_steps = 0: must be at least 1"),
    ],
)
def test_bad_configurations_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SimulatedBench(SimulationConfig(**fields))  # type: ignore[arg-type]
