"""Hosts on this machine: network namespaces, each with its own interfaces, and a cable between two of them.

DDS finds the other host by multicast and talks to it over UDP, as between two machines. Creating them requires root on
Linux; otherwise NotPermittedError gives the reason.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

#: Name of the interface that the cable is plugged into, on both hosts.
INTERFACE = "veth0"
_CLONE_NEWNET = 0x40000000
_NAMES = Path("/run/netns")


class NotPermittedError(Exception):
    """This machine does not allow network namespaces to be made; the message gives the reason."""


def ip(*arguments: str) -> str:
    """Run ip(8); returns its output.

    Raises:
        NotPermittedError: it is missing or refuses.
    """
    program = shutil.which("ip")
    if program is None:
        raise NotPermittedError("there is no program `ip` (package iproute2)")
    done = subprocess.run([program, *arguments], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise NotPermittedError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


def command_on(host: str) -> list[str]:
    """The words in front of a command that make it run on a host."""
    return ["ip", "netns", "exec", host]


@contextlib.contextmanager
def one_host() -> Iterator[str]:
    """Name of a host that reaches only itself."""
    name = f"dm-{os.getpid()}-0"
    ip("netns", "add", name)
    try:
        ip("-n", name, "link", "set", "lo", "up", "multicast", "on")
        ip("-n", name, "route", "add", "224.0.0.0/4", "dev", "lo")
        yield name
    finally:
        ip("netns", "del", name)


@contextlib.contextmanager
def unconnected_hosts() -> Iterator[tuple[str, str]]:
    """Names of two hosts without a cable; give both an interface INTERFACE and call `bring_up`."""
    names = [f"dm-{os.getpid()}-{side}" for side in (1, 2)]
    made: list[str] = []
    try:
        for name in names:
            ip("netns", "add", name)
            made.append(name)
        yield names[0], names[1]
    finally:
        for name in made:
            ip("netns", "del", name)


def bring_up(*hosts: str) -> None:
    """Give each host's interfaces their addresses, and a route for multicast."""
    for number, name in enumerate(hosts, 1):
        ip("-n", name, "address", "add", f"10.77.0.{number}/24", "dev", INTERFACE)
        ip("-n", name, "link", "set", "lo", "up")
        ip("-n", name, "link", "set", INTERFACE, "up")
        ip("-n", name, "route", "add", "224.0.0.0/4", "dev", INTERFACE)


@contextlib.contextmanager
def two_hosts() -> Iterator[tuple[str, str]]:
    """Names of two hosts that reach each other over a cable (veth) that has no delay of its own."""
    with unconnected_hosts() as (left, right):
        ip("link", "add", INTERFACE, "netns", left, "type", "veth", "peer", "name", INTERFACE, "netns", right)
        bring_up(left, right)
        yield left, right


def received_bytes(host: str) -> int:
    """Number of bytes received over the cable so far."""
    links = json.loads(ip("-n", host, "-s", "-json", "link", "show", INTERFACE))
    return int(links[0]["stats64"]["rx"]["bytes"])


@contextlib.contextmanager
def inside(host: str) -> Iterator[None]:
    """Move this thread, and the threads and sockets that it makes meanwhile, to a host.

    Raises:
        NotPermittedError: this user may not do so.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open("rb") as before, (_NAMES / host).open("rb") as namespace:
        if libc.setns(namespace.fileno(), _CLONE_NEWNET) != 0:
            raise NotPermittedError(f"setns: {os.strerror(ctypes.get_errno())}")
        try:
            yield
        finally:
            libc.setns(before.fileno(), _CLONE_NEWNET)
