"""Shared memory of Fast DDS: which processes use it, and removal of the segments that killed processes leave."""

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

#: Environment variables: the Fast DDS profile, how far nodes look for each other, and peers on other machines.
PROFILE, RANGE, PEERS = "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
#: The profiles of dm_bringup: with shared memory, UDP only, and UDP only within the machine.
WHOLE, UDP, UDP_LOCAL = "fastdds.xml", "fastdds_udp.xml", "fastdds_udp_local.xml"
#: Folder of the segments of Fast DDS; age up to which a segment may not be locked by its process yet, s.
SHARED_MEMORY, LEAST_AGE_S = Path("/dev/shm"), 2.0


def use_udp_alone() -> None:
    """Keep this process from using shared memory: select a UDP profile from the folder of the suite's profile.

    To be called before ROS is initialised. With the range LOCALHOST, rmw_fastrtps would add shared memory to any
    profile, so a profile that confines UDP to the machine replaces that range. Nothing changes with a profile of the
    user's own, with another middleware (only LOCALHOST confines it), or with peers beside LOCALHOST (lost without it).
    """
    profile, local = Path(os.environ.get(PROFILE) or "none"), os.environ.get(RANGE) == "LOCALHOST"
    alone = profile.with_name(UDP_LOCAL if local else UDP)
    if profile.name not in (WHOLE, UDP, UDP_LOCAL) or not alone.is_file() or (local and os.environ.get(PEERS)):
        return
    if get_rmw_implementation_identifier().startswith("rmw_fastrtps"):
        os.environ[PROFILE] = str(alone)
        if local:
            os.environ[RANGE] = "SYSTEM_DEFAULT"


def remove_orphaned_segments(least_age_s: float = LEAST_AGE_S) -> None:
    """Remove Fast DDS segments whose process is gone.

    Fast DDS removes its segment (17 MB, see config/fastdds.xml of dm_bringup) when a node ends, but not when it is
    killed, so memory runs out after some hundred kills. The owner of the segment `fastrtps_ID` holds a lock on the file
    `fastrtps_ID_el` as long as it lives. Segments of ports, named by number, are taken over by Fast DDS itself.
    """
    for lock in SHARED_MEMORY.glob("fastrtps_*_el"):
        if lock.name.startswith("fastrtps_port"):
            continue
        # Segments that are locked, owned by others, or just being removed by another node are left alone.
        with suppress(OSError), lock.open("r+b") as handle:
            if abs(time.time() - lock.stat().st_mtime) >= least_age_s:  # the clock may have been set back
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                lock.with_name(lock.name.removesuffix("_el")).unlink(missing_ok=True)
                lock.unlink()
