"""All faults of `./dm faults`, by group."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fault_injection.fault import Fault
from fault_injection.faults import (
    calibration_faults,
    controller_faults,
    driver_faults,
    goal_faults,
    network_faults,
    process_faults,
    wire_faults,
)

#: In the order in which they run.
GROUPS: Mapping[str, tuple[Fault, ...]] = {
    "driver": tuple(driver_faults.REGISTRY.values()),
    "wire": wire_faults.FAULTS,
    "controller": controller_faults.FAULTS + goal_faults.FAULTS,
    "processes": process_faults.FAULTS,
    "calibration": calibration_faults.FAULTS,
    "network": network_faults.FAULTS,
}
#: What `--faults` takes beside groups and single faults.
OTHERS = ("fuzz", "soak")


def select(names: Sequence[str]) -> list[Fault]:
    """The faults with these names, of faults or groups, in order and each once; all where there are no names.

    Raises:
        ValueError: no such fault or group.
    """
    singles = {fault.name: fault for faults in GROUPS.values() for fault in faults}
    unknown = [name for name in names if name not in singles and name not in GROUPS]
    if unknown:
        raise ValueError(
            f"faults = {', '.join(unknown)}: must be groups ({', '.join((*GROUPS, *OTHERS))}) or among "
            f"{', '.join(singles)}"
        )
    if not names:
        return list(singles.values())
    chosen: dict[str, Fault] = {}
    for name in names:
        chosen |= {fault.name: fault for fault in GROUPS.get(name) or (singles[name],)}
    return list(chosen.values())
