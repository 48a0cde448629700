"""Which ROS domains are lent."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from dm_common.ros.domains import COMMAND_MAX, PORT_BASE, PORTS, held_by, inhabited_domains, own_domain


def test_ports_that_are_in_use_tell_the_domains(tmp_path: Path) -> None:
    table = tmp_path / "udp"
    table.write_text(
        "  sl  local_address rem_address   st\n"
        "   1: 0100007F:1CE8 00000000:0000 07\n"  # 7400
        "   2: 00000000:1EEC 00000000:0000 07\n"  # 7916
        "   3: 00000000:0044 00000000:0000 07\n"  # 68
    )
    assert inhabited_domains((table, tmp_path / "none")) == {0, 2}


def test_a_domain_in_which_somebody_was_left_is_not_lent() -> None:
    with own_domain() as domain:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as left_over:
        left_over.bind(("127.0.0.1", PORT_BASE + PORTS * domain + PORTS - 1))
        with own_domain() as other:
            assert other != domain


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_who_holds_a_port_is_named(kind: socket.SocketKind) -> None:
    with socket.socket(socket.AF_INET, kind) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        port = endpoint.getsockname()[1]
        if kind == socket.SOCK_STREAM:
            endpoint.listen()
        command = " ".join(sys.orig_argv[:3])[:COMMAND_MAX]
        assert f" by {command} (process {os.getpid()}, ROS domain " in held_by(port)
    assert held_by(port) == ""


def test_a_file_closed_meanwhile_hides_no_holder(tmp_path: Path) -> None:
    """As the list of this process's own files, which takes the lowest number that is free."""
    closed = (tmp_path / "closed").open("w")
    with socket.create_server(("127.0.0.1", 0)) as endpoint:
        closed.close()
        assert f"(process {os.getpid()}, " in held_by(endpoint.getsockname()[1])
