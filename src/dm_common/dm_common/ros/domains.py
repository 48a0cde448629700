"""ROS domains that isolate runs on one machine from each other, and which process holds a file or a port."""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

#: UDP ports of DDS: the first one of domain 0, and how many each domain has.
PORT_BASE, PORTS = 7400, 250
#: Where the kernel lists the UDP ports in use.
UDP_PORTS = (Path("/proc/net/udp"), Path("/proc/net/udp6"))
PROCESSES = Path("/proc")
#: Number of characters of a command line that are shown.
COMMAND_MAX = 120


def inhabited_domains(tables: Iterable[Path] = UDP_PORTS) -> set[int]:
    """ROS domains in which a process of this machine listens, whoever started it."""
    ports = set()
    for table in tables:
        with contextlib.suppress(OSError):
            ports |= {int(line.split()[1].rpartition(":")[2], 16) for line in table.read_text().splitlines()[1:]}
    return {(port - PORT_BASE) // PORTS for port in ports if port >= PORT_BASE}


def holders(targets: Collection[Path]) -> list[str]:
    """Processes that have one of these files open, as far as permissions allow: command, id and ROS domain."""
    found = []
    for process in PROCESSES.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # not ours, or gone meanwhile
            if any(_leads_to(link) in targets for link in (process / "fd").iterdir()):
                command = (process / "cmdline").read_text(errors="replace").split("\0")[:3]
                variables = (process / "environ").read_text(errors="replace").split("\0")
                domain = dict(variable.partition("=")[::2] for variable in variables).get("ROS_DOMAIN_ID") or "0"
                found.append(f"{' '.join(command).strip()[:COMMAND_MAX]} (process {process.name}, ROS domain {domain})")
    return found


def _leads_to(link: Path) -> Path | None:
    """What an open file is; None = closed meanwhile, as the list of open files itself."""
    try:
        return link.readlink()
    except FileNotFoundError:
        return None


def held_by(port: int) -> str:
    """Which processes hold this TCP or UDP port of the machine, as `holders` names them: " by ..."; "" = not known."""
    sockets = set()
    for table in (*UDP_PORTS, *(path.with_name(path.name.replace("udp", "tcp")) for path in UDP_PORTS)):
        with contextlib.suppress(OSError):
            rows = [line.split() for line in table.read_text().splitlines()[1:]]
            sockets |= {Path(f"socket:[{row[9]}]") for row in rows if int(row[1].rpartition(":")[2], 16) == port}
    found = holders(sockets)
    return f" by {', '.join(found)}" if found else ""


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Lend a ROS domain that no other demo or test on this machine uses at the same time.

    Domains with leftover nodes are skipped too: a killed run loses its lock, but its nodes may live on.
    """
    folder = Path(tempfile.gettempdir()) / f"dm-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for domain in range(1, 100):
        with (folder / str(domain)).open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if domain not in inhabited_domains():
                yield domain
                return
    raise RuntimeError("no free ROS domain: 99 runs at once?")
