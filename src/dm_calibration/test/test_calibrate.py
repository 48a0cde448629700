"""`calibrate` without ROS: from files and from arrays, with the examples, and what it refuses."""

from __future__ import annotations

import runpy
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dm_calibration import calibrate, calibrator
from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.acquisition.map_sources import outcome_of
from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.features import follow
from dm_calibration.hysteresis.hysteresis_fit import NO_DEGAUSS, fit_hysteresis
from dm_calibration.influence.fit import FitOptions, fit_influence
from dm_calibration.influence.regression import TooFewMapsError
from dm_calibration.influence.screening import unusable
from dm_calibration.optics.aperture import InsufficientDataError
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common import Floats
from dm_common.errors import MeasurementError, Refusal
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_common.mirror import Mirror
from dm_common.optics.sampling import SamplePoints
from hysteretic_mirror import MIRROR, lagging_bench
from linear_mirror import RADIUS, LinearMirror, make_mirror
from map_fixtures import NO_DATA, dat_bytes, four_d_bytes
from map_hashes import measurements

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
SIZE = 61
PITCH = 2.0 * RADIUS / (SIZE - 1)
COUNT = 0.5 * 632.8e-9 / 32768.0  # m per count of a .dat file of the fixtures


def plant_on_pixels(mirror: Mirror) -> tuple[LinearMirror, NDArray[np.bool_]]:
    """A mirror whose sag is known at every pixel, and the pixels of its aperture."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    x, y = (columns - 30.0) / 30.0, (30.0 - rows) / 30.0
    inside = np.hypot(x, y) <= 1.0
    points = SamplePoints(x.ravel(), y.ravel(), inside.ravel() / inside.sum())
    return LinearMirror(mirror.x, mirror.y, points=points), inside


def seen(plant: LinearMirror, inside: NDArray[np.bool_], signals: Floats) -> Floats:
    """(M, height, width) m, NaN outside the aperture."""
    return np.stack([np.where(inside, plant.sag(row).reshape(inside.shape), np.nan) for row in signals])


def pokes(mirror: Mirror) -> Floats:
    plan = make_plan(PlanKind.POKES, mirror, PlanOptions(degauss=False))
    return np.stack([step.signals for step in plan.steps if step.signals is not None])


def run_example(name: str, argument: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    monkeypatch.setattr(sys, "argv", [name, str(argument)])
    return runpy.run_path(str(EXAMPLES / name))


@pytest.mark.slow
def test_a_folder_of_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    mirror = make_mirror()
    plant, inside = plant_on_pixels(mirror)
    commands = pokes(mirror)
    for number, sag in enumerate(seen(plant, inside, commands)):
        counts = np.where(inside, np.rint(sag / COUNT), NO_DATA).astype(np.int64)
        (tmp_path / f"{number:03d}.dat").write_bytes(dat_bytes(counts, pitch=PITCH, time=1_700_000_000 + 5 * number))
    np.savetxt(tmp_path / "commands.csv", commands, delimiter=",")
    made = run_example("calibrate_folder.py", tmp_path, monkeypatch)
    (file,) = tmp_path.glob("calibrations/*.h5")
    assert outcome_of(tmp_path, commands, None, mirror).records, "the folder still holds maps only"
    calibration = CalibrationStore(file.parent).load(file.stem)
    assert f"stored as {file}" in capsys.readouterr().out
    assert calibration.id == made["calibration"].id  # type: ignore[attr-defined]
    assert repr(calibration).startswith(f"<Calibration {calibration.id}: {len(commands)} maps")
    assert len(repr(calibration)) < 200
    assert calibration.limitations == (calibration.limitations[0],)  # no findings of the poke check among them
    np.testing.assert_allclose(np.diff(calibration.maps.stamp_ns), 5e9)
    assert all(len(digest) == 64 for digest in calibration.maps.sha256)
    true = plant.fit_terms(plant.influence.T).T
    np.testing.assert_allclose(calibration.fit.influence_zernike[3:], true[3:], atol=0.01 * np.abs(true).max())


def test_a_folder_of_maps_whose_names_end_in_capitals(tmp_path: Path) -> None:
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    commands = pokes(mirror)[1:2]
    (tmp_path / "1.4D").write_bytes(four_d_bytes(seen(plant, inside, commands)[0] / 632.8e-9))
    outcome = outcome_of(tmp_path, commands, None, mirror, IngestSettings(pitch=PITCH, aperture_radius=RADIUS))
    assert [Path(record.file).name for record in outcome.records] == ["1.4D"]
    assert abs(outcome.records[0].stamp_ns - time.time_ns()) < 600e9  # a calibration of 1970 would be stale at once
    # Such a file does not tell its time, and a copy of it was written when it was copied.
    with pytest.raises(ValueError, match="times: map 1 has none"):
        outcome_of(tmp_path, commands, None, mirror, IngestSettings(pitch=PITCH, aperture_radius=RADIUS), True)


def test_maps_whose_names_count_without_zeros(tmp_path: Path) -> None:
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    names = ["m.dat", "m0.dat", "m01.dat", "m1.dat", "m2.dat", "m2b.dat", "m10.dat"]
    commands = pokes(mirror)[: len(names)]
    for number, sag in enumerate(seen(plant, inside, commands)):
        counts = np.where(inside, np.rint(sag / COUNT), NO_DATA).astype(np.int64)
        (tmp_path / names[number]).write_bytes(dat_bytes(counts, pitch=PITCH, time=1_700_000_000 + 5 * number))
    outcome = outcome_of(tmp_path, commands, None, mirror)
    assert [Path(record.file).name for record in outcome.records] == names


def test_a_file_without_data_in_a_folder_wants_the_times(tmp_path: Path) -> None:
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    commands = pokes(mirror)[:4]
    for number, sag in enumerate(seen(plant, inside, commands)):
        counts = np.where(inside & (number != 2), np.rint(sag / COUNT), NO_DATA).astype(np.int64)
        (tmp_path / f"{number}.dat").write_bytes(dat_bytes(counts, pitch=PITCH, time=1_700_000_000 + 5 * number))
    # It lies between the others; of the last one that is not known.
    stamps = outcome_of(tmp_path, commands, None, mirror, hysteresis=True).maps().stamp_ns
    assert list(np.diff(stamps[-4:]) / 1e9) == [5.0, 5.0, 5.0]
    (tmp_path / "2.dat").rename(tmp_path / "9.dat")
    with pytest.raises(ValueError, match="times: map 4 has none"):
        outcome_of(tmp_path, commands, None, mirror, hysteresis=True)
    (tmp_path / "9.dat").rename(tmp_path / "2.dat")
    times = 5.0 * np.arange(1, 5)
    outcome = outcome_of(tmp_path, commands, times, mirror, hysteresis=True)
    assert "none of the" in outcome.dropped[0] and outcome.dropped[0].startswith("map 3: ")
    assert [record.stamp_ns / 1e9 for record in outcome.records][-4:] == list(times)
    maps = outcome.maps()
    assert maps.rejected(unusable(maps, 0.5)) == [], "it is among the dropped ones already"


@pytest.mark.slow
def test_what_pokes_of_a_mirror_with_hysteresis_promise_spheres_keep() -> None:
    """A poke shows the loop of one actuator; in a sphere all of them err alike."""
    bench = lagging_bench()
    calibration = calibrate(Procedure(make_plan(PlanKind.POKES, MIRROR), MIRROR, bench).run(), mirror=MIRROR)
    fit = calibration.fit
    assert "no law describes: the error includes" in " ".join(calibration.limitations)
    sphere = np.linalg.pinv(fit.influence_zernike[3:])[:, 0]
    errors = []
    for level in np.random.default_rng(5).uniform(-1.0, 1.0, 40):
        signals = bench.apply(level * sphere / np.abs(sphere).max())
        seen = bench.measure("sphere").coefficients - fit.zernike_offset - fit.influence_zernike @ signals
        errors.append(np.abs(seen[3:]).max())
    bound = fit.held_out_max_zernike
    assert np.mean(np.array(errors) <= bound) >= 0.95 and 0.2 * bound < max(errors)
    # Fitted again it promises the same, inside the limits of its mirror.
    tight = replace(MIRROR, limits=replace(MIRROR.limits, neighbour_difference=0.3))
    again, tighter = (
        calibrator.refit(calibration, FitOptions(), (), calibrator.Provenance("again", 2), mirror).promise
        for mirror in (MIRROR, tight)
    )
    assert again == pytest.approx(bound, rel=1e-9) and tighter < 0.7 * bound
    # The same bench whose signals begin at 0 instead: a move is counted from mid range on.
    maps = replace(calibration.maps, applied=calibration.maps.applied + 1.0)
    pulled = fit_influence(maps, rings=MIRROR.rings, limits=replace(MIRROR.limits, low=0.0, high=2.0))
    assert pulled.held_out_max_zernike == pytest.approx(bound, rel=1e-6)
    # Maps at mid range that are no reference frames take nothing off it.
    unnamed = replace(calibration.maps, kind=("poke",) * len(calibration.maps))
    assert not unnamed.applied[0].any()
    rested = fit_influence(unnamed, rings=MIRROR.rings, limits=MIRROR.limits)
    assert rested.held_out_max_zernike > 0.8 * bound
    # Nor does an actuator without a channel, which stands elsewhere.
    commands = calibration.maps.applied.copy()
    commands[:, -1] = -1.0
    measured = []
    for row in commands:
        bench.apply(row)
        measured.append(bench.measure("again"))
    missing = calibrate(measured, commands, mirror=MIRROR)
    assert missing.maps.kind[:3] == ("reference", "poke", "poke")
    assert missing.promise == pytest.approx(bound, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("pause", "late"), [(0.0, 0.0), (0.8, 0.0), (0.8, 30.0)])
def test_arrays_of_commands_times_and_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pause: float, late: float
) -> None:
    """`pause`: s between a map and the next command, in which a bench saves the map; `late`: s before the first map."""
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    weight = np.array([[0.7], [0.2], [0.1]])
    law = HysteresisModel(np.array([0.0, 0.225, 0.475]), weight, np.zeros(0), 0.0, 0.01, CREEP_TIMES)
    moves = excitation(mirror, 80)
    times = late + np.cumsum(1.0 + moves.dwell + pause)
    moved = np.concatenate(([0.0], times[:-1])) + pause
    effective, _ = follow(law, law.demagnetised(mirror.actuators, 0.0), moves.signals, times, moved)
    sag = seen(plant, inside, effective)
    sag[[0, 7]] = np.nan  # their commands count all the same
    times_of_moves: dict[str, Any] = {"moved": moved} if pause else {}
    file = tmp_path / "run.npz"
    np.savez(
        file,
        x=mirror.x,
        y=mirror.y,
        radius=RADIUS,
        pitch=PITCH,
        commands=moves.signals,
        times=times,
        sag=sag,
        **times_of_moves,
    )
    # Its actuators are alike; laws of each by itself would take most of the time.
    monkeypatch.setattr(calibrator, "fit_hysteresis", partial(fit_hysteresis, candidates=COMMON))
    made = run_example("calibrate_arrays.py", file, monkeypatch)
    last = made["calibration"].maps.stamp_ns[-1]  # type: ignore[attr-defined]
    assert abs(last - time.time_ns()) < 600e9, "times that count from the start of the run date it to the present"
    left_out = [text[:25] for text in made["calibration"].dropped]  # type: ignore[attr-defined]
    assert left_out == ["map 1: 0 valid pixels ins", "map 8: 0 valid pixels ins"]
    known = made["calibration"].hysteresis  # type: ignore[attr-defined]
    assert NO_DEGAUSS in made["calibration"].limitations  # type: ignore[attr-defined]
    assert known.held_out_max_zernike < 0.3e-9
    assert known.law.creep_rate == pytest.approx(0.01, rel=0.2)
    left = made["left"]
    assert isinstance(left, np.ndarray)
    assert np.sqrt(np.nanmean(left**2)) < 3e-9
    assert f"{known.name}: coefficients right to" in capsys.readouterr().out


@pytest.mark.slow
def test_measurements_and_what_is_refused() -> None:
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    commands = pokes(mirror)
    sag, settings = seen(plant, inside, commands), IngestSettings(pitch=PITCH, aperture_radius=RADIUS)
    calibration = calibrate(sag, commands, mirror=mirror, settings=settings)
    again = calibrate(measurements(calibration.maps), commands, mirror=mirror)
    np.testing.assert_array_equal(again.fit.influence_sag, calibration.fit.influence_sag)
    assert calibration.maps.kind[:2] == ("reference", "poke")

    masked = np.ma.masked_array(np.nan_to_num(sag), np.isnan(sag))
    again = calibrate(masked, commands, mirror=mirror, settings=settings)
    np.testing.assert_array_equal(again.fit.influence_sag, calibration.fit.influence_sag)

    with pytest.raises(ValueError, match=r"map 1: its sag spans .*: must be in m, not um or nm"):
        calibrate(1e9 * sag, commands, mirror=mirror, settings=settings)
    with pytest.raises(ValueError, match=r"commands: must be given"):
        calibrate(sag, mirror=mirror)
    with pytest.raises(ValueError, match=r"commands has the shape \(3, 7\): must be \(\d+, 7\) finite numbers"):
        calibrate(sag, commands[:3], mirror=mirror, settings=settings)
    with pytest.raises(ValueError, match=r"times has the shape \(2,\)"):
        calibrate(sag, commands, [0.0, 1.0], mirror=mirror, settings=settings)
    with pytest.raises(ValueError, match=r"times go up to 1\.7e\+18: must be in s, not ns"):
        calibrate(sag, commands, np.full(len(sag), 1.7e18), mirror=mirror, settings=settings)
    with pytest.raises(ValueError, match="times: map 1 has none"):
        calibrate(sag, commands, mirror=mirror, settings=settings, hysteresis=True)
    since_1904 = time.time() + 2_082_844_800.0 + np.arange(len(sag))
    with pytest.raises(ValueError, match=r"times go up to 3\.\d+e\+09 s, which is in the future"):
        calibrate(sag, commands, since_1904, mirror=mirror, settings=settings)
    with pytest.raises(ValueError, match="times: all are equal, so hysteresis cannot be separated"):
        calibrate(sag, commands, np.zeros(len(sag)), mirror=mirror, settings=settings, hysteresis=True)
    times = np.arange(len(sag), dtype=float)
    twice = np.where(times == 2.0, 1.0, times)
    with pytest.raises(ValueError, match="times: maps 2 and 3 have equal times but different commands"):
        calibrate(sag, commands, twice, mirror=mirror, settings=settings, hysteresis=True)
    with pytest.raises(ValueError, match=r"moved has the shape \(2,\): must be"):
        calibrate(sag, commands, times, moved=[0.0, 1.0], mirror=mirror, settings=settings)
    for moved in (times + 0.1, times - 1.1, np.nan * times):
        with pytest.raises(ValueError, match=r"moved: number [12] is .* must lie between the previous map"):
            calibrate(sag, commands, times, moved=moved, mirror=mirror, settings=settings)
    for wrong, text in ({"pitch": np.nan}, "pitch = nan: must be"), ({"retrace": (2.0,)}, r"retrace\[0\] = 2: must be"):
        with pytest.raises(Refusal, match=text):
            calibrate(sag, commands, mirror=mirror, settings=replace(settings, **wrong))
    with pytest.raises(ValueError, match="commands reach 75: must be normalised to -1 to 1"):
        calibrate(sag, 150.0 * commands, mirror=mirror, settings=settings)
    gap = np.where(np.arange(len(sag))[:, None] == 3, np.nan, commands)
    with pytest.raises(ValueError, match="commands: row 4 holds NaN"):
        calibrate(sag, gap, mirror=mirror, settings=settings)
    with pytest.raises(InsufficientDataError, match="map 2: 0 valid pixels"):
        calibrate([sag[0], np.full_like(sag[1], np.nan), *sag[2:]], commands, mirror=mirror, settings=settings)
    # A degauss ends at mid range, also where no map shows it.
    for low, rest in ((-1.0, 0.0), (-0.5, 0.25)):
        pulled = replace(mirror, limits=replace(mirror.limits, low=low))
        maps = outcome_of(sag[1:], commands[1:], np.arange(1.0, len(sag)), pulled, settings, hysteresis=True).maps()
        assert maps.rest == rest and len(maps) == len(sag) - (rest == 0.0)
    with pytest.raises(TooFewMapsError, match="good maps for"):
        calibrate(sag[:2], commands[:2], mirror=mirror, settings=settings)
    with pytest.raises(MeasurementError, match=r"map 1: aperture radius 8\.000 mm"):
        calibrate(sag, commands, mirror=mirror, settings=replace(settings, aperture_radius=8e-3))


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no map file"):
        calibrate(tmp_path, np.zeros((1, 7)), mirror=make_mirror(rings=1))


@pytest.mark.parametrize("stamp", [np.inf, np.nan, 1e15, 2e10, -5.0])
def test_a_time_in_a_file_that_can_be_none_is_not_known(
    stamp: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mirror = make_mirror(rings=1)
    plant, inside = plant_on_pixels(mirror)
    commands = pokes(mirror)[:1]
    counts = np.where(inside, np.rint(seen(plant, inside, commands)[0] / COUNT), NO_DATA).astype(np.int64)
    (tmp_path / "1.dat").write_bytes(dat_bytes(counts, pitch=PITCH))
    read = Ingest.read

    def damaged(ingest: Ingest, *arguments: Any) -> Any:
        surface, measured = read(ingest, *arguments)
        return replace(surface, time_stamp=stamp), measured

    monkeypatch.setattr(Ingest, "read", damaged)
    outcome = outcome_of(tmp_path, commands, None, mirror)
    assert abs(outcome.records[0].stamp_ns - time.time_ns()) < 600e9
