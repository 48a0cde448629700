"""`dm report` on a store, without nodes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, PlanOptions
from dm_calibration.store.calibration_store import CalibrationStore
from dm_tools.verbs import report as verb
from dm_tools.verbs.report import find_calibration, report
from hysteretic_mirror import MIRROR
from recorded_bench import recorded

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CalibrationStore:
    """An older and a newer calibration."""
    store = CalibrationStore(tmp_path_factory.mktemp("store"))
    outcome = recorded(PlanKind.POKES, PlanOptions())[1]
    older = calibrate(outcome, mirror=MIRROR, options=FitOptions(), provenance=Provenance("older", 10**18))
    store.save(older)
    store.save(replace(older, id="newer", created_ns=2 * 10**18))
    return store


@pytest.fixture(autouse=True)
def _nothing_runs(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))


def test_the_newest_is_reported(store: CalibrationStore, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    report("", tmp_path / "out", store.folder, json=figures)
    summary = json.loads(figures.read_text())
    assert summary["id"] == "newer"
    assert summary["remeasured_max_zernike_nm"] is None
    assert Path(summary["files"]["html"]).name == "newer.html" and Path(summary["files"]["pdf"]).is_file()


def test_an_id_or_a_file_anywhere_is_found(
    store: CalibrationStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_calibration("older", store)[0].id == "older"
    elsewhere = CalibrationStore(tmp_path)
    in_use = store.find("newer"), CRITERIA, ""
    monkeypatch.setattr(verb, "running_calibration", lambda _namespace: in_use)  # its node has a folder of its own
    report("older", tmp_path / "out", json=tmp_path / "figures.json")
    assert json.loads((tmp_path / "figures.json").read_text())["id"] == "older"
    assert find_calibration(str(store.find("older")), elsewhere)[1] == store.find("older")
    with pytest.raises(ValueError, match="calibrate first"):
        find_calibration("", elsewhere)
    monkeypatch.setattr(verb, "running_calibration", lambda _namespace: (None, CRITERIA, ""))
    monkeypatch.setattr(verb, "VIRTUAL", tmp_path / "bench")
    monkeypatch.setattr(verb, "HARDWARE", tmp_path / "hardware")
    with pytest.raises(ValueError, match=r"bench/calibrations or .*hardware: calibrate first"):
        report("", tmp_path / "out")
    # Another mirror's calibration is not that of a namespace, which has a folder of its own.
    CalibrationStore(tmp_path / "bench" / "calibrations").save(store.load("older"))
    CalibrationStore(tmp_path / "bench" / "left" / "calibrations").save(store.load("newer"))
    for namespace, name in (("", "older"), ("/left", "newer")):
        report("", tmp_path / "out", namespace=namespace, json=tmp_path / "figures.json")
        assert json.loads((tmp_path / "figures.json").read_text())["id"] == name
    with pytest.raises(ValueError, match=r"bench/right/calibrations or .*hardware: calibrate first"):
        report("", tmp_path / "out", namespace="right")
    with pytest.raises(ValueError, match="no such file"):
        find_calibration("older", elsewhere)
