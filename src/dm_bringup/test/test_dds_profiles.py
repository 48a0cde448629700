"""What the Fast DDS profiles have in common."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

CONFIG = Path(__file__).parents[1] / "config"
#: What keeps nodes to one machine, or lets them look beyond it.
PEERS = ("initialPeersList", "metatrafficUnicastLocatorList")


def read(name: str) -> tuple[list[str | None], bytes]:
    """Kinds of transports; all but those for shared memory, and but the peers."""
    root = ElementTree.parse(CONFIG / name).getroot()
    kinds = [kind.text for kind in root.iterfind(".//{*}type")]
    for parent in list(root.iter()):
        for child in list(parent):
            tag = child.tag.rpartition("}")[2]
            named = tag in ("transport_descriptor", "transport_id")
            if tag in PEERS or (named and "dm_shared_memory" in "".join(child.itertext())):
                parent.remove(child)
    return kinds, b"".join(ElementTree.tostring(root).split())


@pytest.mark.parametrize("name", ["fastdds_udp.xml", "fastdds_udp_local.xml"])
def test_profiles_differ_by_shared_memory_and_peers_alone(name: str) -> None:
    transports, rest = read("fastdds.xml")
    assert transports == ["SHM", "UDPv4"]
    assert read(name) == (["UDPv4"], rest)


HEARS = """
import sys, rclpy
from std_msgs.msg import String
from rclpy.qos import DurabilityPolicy, QoSProfile
rclpy.init()
node, found = rclpy.create_node("hears"), []
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(String, "text", found.append, latched)
while not found:
    rclpy.spin_once(node)
print(len(found[0].data))
"""
SENDS = (
    HEARS.partition("node.create_sub")[0].replace("hears", "sends")
    + """
publisher = node.create_publisher(String, "text", latched)
publisher.publish(String(data=200_000 * "x"))
input()
"""
)


@pytest.mark.parametrize("own", ["sends", "hears"])
def test_nodes_understand_programs_without_the_profile(own: str, domain: int) -> None:
    """Those send datagrams of up to 64 kB."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("FASTRTPS", "ROS_AUTO"))}
    environment |= {"ROS_DOMAIN_ID": str(domain)}
    profiled = environment | {"FASTRTPS_DEFAULT_PROFILES_FILE": str(CONFIG / "fastdds_udp_local.xml")}
    of_sender, of_hearer = (profiled, environment) if own == "sends" else (environment, profiled)
    command = [sys.executable, "-c"]
    with subprocess.Popen([*command, SENDS], env=of_sender, stdin=subprocess.PIPE) as sender:
        try:
            heard = subprocess.run([*command, HEARS], env=of_hearer, capture_output=True, timeout=30.0, check=True)
        finally:
            sender.communicate(b"\n")
    assert int(heard.stdout) == 200_000
