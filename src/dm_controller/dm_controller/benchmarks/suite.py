"""All jobs in order. A job is a function (effort, rivals) -> figures by name, as they appear in the JSON file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import ModuleType
from typing import Any

from dm_controller.benchmarks import bounded_solve, influence_maps, map_fitting, map_reading, scaling
from dm_controller.benchmarks.timing import Effort, machine

Job = Callable[[Effort, dict[str, ModuleType]], dict[str, Any]]

#: By the name that `--only` takes. The hysteresis inverse (`inverse`) and the measurements over ROS (`relay`, `focus`,
#: `file_to_coefficients`) belong here too, each in a module of its own; their lines go to `targets.TARGETS`.
JOBS: Mapping[str, Job] = {
    "fit": map_fitting.measure,
    "read": map_reading.measure,
    "influence": influence_maps.measure,
    "solve": bounded_solve.measure,
    "scaling": scaling.measure,
}


def run(
    names: list[str], effort: Effort, rivals: dict[str, ModuleType], step: Callable[[str], None] = lambda name: None
) -> dict[str, Any]:
    """Run jobs and collect their figures, with the facts of the machine under `machine`.

    Args:
        names: of JOBS; empty = all.
        step: called with the name of each job before it runs.

    Raises:
        ValueError: an unknown name, with the known ones.
    """
    figures: dict[str, Any] = {"machine": machine(), "quick": effort.quick}
    for name, job in _chosen(names):
        step(name)
        figures |= job(effort, rivals)
    return figures


def _chosen(names: list[str]) -> Iterator[tuple[str, Job]]:
    unknown = sorted(set(names) - JOBS.keys())
    if unknown:
        raise ValueError(f"--only {', '.join(unknown)}: must be one of {', '.join(JOBS)}")
    return ((name, job) for name, job in JOBS.items() if not names or name in names)
