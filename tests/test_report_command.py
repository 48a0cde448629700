"""`dm report` on a store, without nodes; and the layouts that are shipped for other tools."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from dm_calibration.calibrator import Provenance, evaluate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.plan import PlanKind, PlanOptions
from dm_calibration.store import CalibrationStore
from dm_controller.cli.report import find_calibration, report
from recorded_bench import recorded
from remembering_mirror import MIRROR

CONFIG = Path(__file__).resolve().parents[1] / "src" / "dm_controller" / "config"
MESSAGES = CONFIG.parents[1] / "dm_msgs" / "msg"
#: Message type of the topics that layouts show.
TYPES = {"zernike": "ZernikeCoefficients", "focus_state": "FocusState", "actuator_state": "ActuatorState"}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CalibrationStore:
    """An older and a newer calibration."""
    store = CalibrationStore(tmp_path_factory.mktemp("store"))
    outcome = recorded(PlanKind.POKES, PlanOptions())[1]
    older = evaluate(outcome, MIRROR, FitOptions(), Provenance("older", 10**18))[0]
    store.save(older)
    store.save(replace(older, id="newer", created_ns=2 * 10**18))
    return store


def test_the_newest_is_reported(store: CalibrationStore, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    report("", tmp_path / "out", store.folder, figures)
    told = json.loads(figures.read_text())
    assert told["id"] == "newer"
    assert told["remeasured_max_zernike_nm"] is None
    assert Path(told["files"]["html"]).name == "newer.html" and Path(told["files"]["pdf"]).is_file()


def test_an_id_or_a_file_anywhere_is_found(store: CalibrationStore, tmp_path: Path) -> None:
    assert find_calibration("older", store)[0].id == "older"
    elsewhere = CalibrationStore(tmp_path)
    assert find_calibration(str(store.find("older")), elsewhere)[1] == store.find("older")
    with pytest.raises(ValueError, match="calibrate first"):
        find_calibration("", elsewhere)
    with pytest.raises(ValueError, match="no such file"):
        find_calibration("older", elsewhere)


def shown_fields() -> dict[str, set[tuple[str, str]]]:
    """(topic, field) that each layout plots."""
    foxglove: dict[str, Any] = json.loads((CONFIG / "foxglove.json").read_text())
    paths = [path["value"] for panel in foxglove["configById"].values() for path in panel.get("paths", ())]
    curves = [str(curve.get("name")) for curve in ElementTree.parse(CONFIG / "plotjuggler.xml").getroot().iter("curve")]
    pattern = re.compile(r"/(\w+)[./](\w+)")
    result = {}
    for name, values in (("foxglove", paths), ("plotjuggler", curves)):
        found = [pattern.match(value) for value in values]
        result[name] = {(match[1], match[2]) for match in found if match}
    return result


@pytest.mark.parametrize("layout", ["foxglove", "plotjuggler"])
def test_layouts_show_fields_that_exist(layout: str) -> None:
    shown = shown_fields()[layout]
    assert {topic for topic, _field in shown} == TYPES.keys()
    for topic, field in shown:
        text = (MESSAGES / f"{TYPES[topic]}.msg").read_text()
        assert re.search(rf"^\w+(\[\])? {field}\b", text, re.MULTILINE), f"{layout}: {topic} has no {field}"


def test_every_panel_of_the_foxglove_layout_is_placed() -> None:
    layout = json.loads((CONFIG / "foxglove.json").read_text())

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


def test_rviz_shows_the_map() -> None:
    displays = yaml.safe_load((CONFIG / "bench.rviz").read_text())["Visualization Manager"]["Displays"]
    assert [display["Topic"]["Value"] for display in displays] == ["surface_map"]
