"""The layouts that are shipped for RViz, rqt, PlotJuggler and Foxglove: panels, topics and fields that exist."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from dm_msgs.msg import FocusState
from sensor_msgs.msg import Image

from dm_common.ros import qos
from dm_common.ros.parameters import frame_id
from dm_tools.console import console_node
from dm_tools.security.interfaces import interfaces

CONFIG = Path(__file__).resolve().parents[2] / "dm_bringup" / "config"
#: What layouts may show: the console's topics, and the focus, of which it shows what `actuator_state` says.
TOPICS = console_node.TOPICS | {"focus_state": (FocusState, qos.STATE)}
#: Topics that every ROS 2 system has.
STANDARD = {"diagnostics", "rosout"}
#: Panel types of Foxglove and Lichtblick that the layout uses, and the settings each of them reads.
PANELS = {
    "Image": {"imageMode"},
    "Plot": {
        "paths",
        "minYValue",
        "maxYValue",
        "showLegend",
        "legendDisplay",
        "showPlotValuesInLegend",
        "showXAxisLabels",
        "showYAxisLabels",
        "isSynced",
        "xAxisVal",
        "sidebarDimension",
    },
    "DiagnosticSummary": {"minLevel", "pinnedIds", "hardwareIdFilter", "topicToRender"},
    "RosOut": {"searchTerms", "minLogLevel", "topicToRender"},
    "RawMessages": {"topicPath", "diffEnabled", "showFullMessageForDiff"},
}
TITLE = "foxglovePanelTitle"
#: Plugins of rqt by package: the names in their plugin.xml.
RQT_PLUGINS = {"rqt_plot/Plot", "rqt_image_view/ImageView", "rqt_runtime_monitor/RuntimeMonitor", "rqt_console/Console"}


def foxglove() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((CONFIG / "foxglove.json").read_text())
    return content


def perspective() -> dict[str, Any]:
    """The plugin manager's part of rqt's perspective."""
    content: dict[str, Any] = json.loads((CONFIG / "bench.perspective").read_text())["groups"]["pluginmanager"]
    return content


def value_of(entry: dict[str, str]) -> Any:
    """A setting as rqt stores it."""
    assert entry["type"] == "repr"
    return ast.literal_eval(entry["repr"])


def plotted() -> dict[str, set[tuple[str, str]]]:
    """(topic, field) of every curve of each layout."""
    fox = [path["value"] for panel in foxglove()["configById"].values() for path in panel.get("paths", ())]
    curves = [str(curve.get("name")) for curve in ElementTree.parse(CONFIG / "plotjuggler.xml").getroot().iter("curve")]
    groups = perspective()["groups"].items()
    plots = [group["groups"]["plugin"]["keys"]["topics"] for name, group in groups if "rqt_plot" in name]
    rqt = [topic for entry in plots for topic in value_of(entry)]
    pattern = re.compile(r"/(\w+)[./](\w+)(?:\[[\d:]+\])?$")
    found = {"foxglove": fox, "plotjuggler": curves, "rqt": rqt}
    matches = {layout: [pattern.match(text) for text in texts] for layout, texts in found.items()}
    assert all(match for each in matches.values() for match in each)
    return {layout: {(match[1], match[2]) for match in each if match} for layout, each in matches.items()}


@pytest.mark.parametrize("layout", ["foxglove", "plotjuggler", "rqt"])
def test_every_curve_is_a_field_of_a_message_that_is_published(layout: str) -> None:
    shown = plotted()[layout]
    assert {topic for topic, _field in shown} == {"zernike", "focus_state", "actuator_state"}
    for topic, field in shown:
        assert field in TOPICS[topic][0].get_fields_and_field_types(), f"{layout}: {topic} has no {field}"


def test_every_foxglove_panel_is_of_a_known_type_with_known_settings_and_placed() -> None:
    content = foxglove()
    for name, settings in content["configById"].items():
        assert settings.keys() - {TITLE} <= PANELS[name.split("!")[0]], name

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(content["layout"])) == sorted(content["configById"])
    assert content.keys() <= {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}


def test_every_topic_of_a_foxglove_panel_is_published() -> None:
    content = foxglove()
    outputs = {re.search(r'output = "(.+)"', script["sourceCode"])[1] for script in content["userNodes"].values()}  # type: ignore[index]
    for name, settings in content["configById"].items():
        image = settings.get("imageMode", {}).get("imageTopic")
        topic = image or settings.get("topicPath") or settings.get("topicToRender")
        if topic is not None and topic not in outputs:
            assert topic.lstrip("/") in TOPICS.keys() | STANDARD, name


@pytest.mark.skipif(shutil.which("node") is None, reason="no node in PATH; run it with: sudo apt-get install nodejs")
def test_the_script_of_the_foxglove_layout_paints_the_map(tmp_path: Path) -> None:
    (script,) = foxglove()["userNodes"].values()
    plain = re.sub(r"^import .*$", "", script["sourceCode"], flags=re.MULTILINE)
    plain = re.sub(r": (?:number\[\]|number|Input<[^>]*>)(?=[,)])|\): (?:number|Message<[^>]*>)(?= \{)", _bare, plain)
    sag = np.array([[1e-7, np.nan, -1e-7], [0.0, 5e-8, 0.0]], dtype="<f4")
    call = (
        f"const data = Uint8Array.from({list(sag.tobytes())});"
        "const header = {stamp: {sec: 1, nsec: 2}, frame_id: 'mirror'};"
        "const message = {header, width: 3, height: 2, is_bigendian: 0, step: 12, data};"
        "const made = script({topic: inputs[0], message});"
        "console.log(JSON.stringify({...made, data: [...made.data]}));"
    )
    file = tmp_path / "script.mjs"
    file.write_text(plain + call)
    done = subprocess.run(["node", str(file)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    made = json.loads(done.stdout)
    assert (made["width"], made["height"], made["step"], made["encoding"]) == (3, 2, 12, "rgba8")
    pixels = np.array(made["data"]).reshape(2, 3, 4)
    assert pixels[0, 0].tolist() == [255, 234, 70, 255]  # the largest
    assert pixels[0, 2].tolist() == [0, 34, 78, 255]  # the smallest
    assert pixels[0, 1, 3] == 0  # no data
    assert pixels[1, 0].tolist() == [124, 123, 120, 255]  # half way


def _bare(match: re.Match[str]) -> str:
    return ")" if match[0].startswith(")") else ""


def test_rqt_opens_plugins_that_exist() -> None:
    content = perspective()
    running = value_of(content["keys"]["running-plugins"])
    assert running.keys() <= RQT_PLUGINS
    instances = {f"plugin__{name.replace('/', '__')}__{n}" for name, numbers in running.items() for n in numbers}
    assert instances == content["groups"].keys()
    image = content["groups"]["plugin__rqt_image_view__ImageView__1"]["groups"]["plugin"]["keys"]
    assert value_of(image["topic"]).lstrip("/") in TOPICS
    assert value_of(image["dynamic_range"])  # a sag in metres would be black


def test_rviz_shows_the_map() -> None:
    """As the interferometer offers it, the last one too: one that asks for more gets no map, and RViz counts none."""
    manager = yaml.safe_load((CONFIG / "bench.rviz").read_text())["Visualization Manager"]
    display, *_stack = manager["Displays"]
    topic = display["Topic"]
    assert display["Class"] == "rviz_default_plugins/Image" and display["Enabled"] and display["Normalize Range"]
    assert topic["Value"] in TOPICS and TOPICS[topic["Value"]][0] is Image
    offered = qos.LATCHED
    assert (topic["Reliability Policy"], offered.reliability) == ("Reliable", offered.reliability.RELIABLE)
    assert (topic["Durability Policy"], offered.durability) == ("Transient Local", offered.durability.TRANSIENT_LOCAL)
    assert topic["Depth"] == offered.depth
    node: Any = SimpleNamespace(get_namespace=lambda: "/")
    assert manager["Global Options"]["Fixed Frame"] == frame_id(node, "")


def test_rviz_shows_a_focus_stack() -> None:
    """Its latched topics, and the points that depth_image_proc makes of them, once somebody switches them on."""
    manager = yaml.safe_load((CONFIG / "bench.rviz").read_text())["Visualization Manager"]
    *images, points = manager["Displays"][1:]
    (autofocus,) = (node for node in interfaces() if node.name == "autofocus")
    for display in images:
        topic = display["Topic"]
        assert display["Class"] == "rviz_default_plugins/Image" and display["Enabled"]
        assert topic["Value"] in autofocus.publish
        assert (topic["Reliability Policy"], topic["Durability Policy"]) == ("Reliable", "Transient Local")
    assert [display["Topic"]["Value"] for display in images] == ["focus_stack/image", "focus_stack/depth"]
    assert not images[1]["Normalize Range"], "to infinity, all would be black"
    assert points["Class"] == "rviz_default_plugins/PointCloud2" and points["Topic"]["Value"] == "points"
    assert not points["Enabled"], "without the node, and in the frame of the mirror, it would be an error"
