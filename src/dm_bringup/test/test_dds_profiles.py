"""What the Fast DDS profiles have in common."""

from __future__ import annotations

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
