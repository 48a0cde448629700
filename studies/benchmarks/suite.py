"""All jobs in order. A job is a function (effort, rivals) -> figures by name, as they appear in the JSON file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

from studies.benchmarks.jobs import (
    bounded_solve,
    calibration_time,
    hysteresis_inverse,
    influence_maps,
    map_fitting,
    map_reading,
    scaling,
)
from studies.benchmarks.ros_jobs import hosts, idle, map_to_coefficients, request_to_command
from studies.benchmarks.timing import Effort, machine

Job = Callable[[Effort, dict[str, ModuleType]], dict[str, Any]]

#: By the name that `--only` takes. Jobs from `focus` on start nodes in processes of their own, except `calibration`.
JOBS: Mapping[str, Job] = {
    "fit": map_fitting.measure,
    "read": map_reading.measure,
    "influence": influence_maps.measure,
    "solve": bounded_solve.measure,
    "inverse": hysteresis_inverse.measure,
    "scaling": scaling.measure,
    "focus": request_to_command.measure,
    "files": map_to_coefficients.measure,
    "idle": idle.measure,
    "calibration": calibration_time.measure,
    "hosts": hosts.measure,
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
    for name, job in chosen(names):
        step(name)
        figures |= job(effort, rivals)
    return figures


def chosen(names: list[str]) -> list[tuple[str, Job]]:
    """The jobs of these names in order; empty = all. Raises ValueError for an unknown name, with the known ones."""
    unknown = sorted(set(names) - JOBS.keys())
    if unknown:
        raise ValueError(f"--only {', '.join(unknown)}: must be one of {', '.join(JOBS)}")
    return [(name, job) for name, job in JOBS.items() if not names or name in names]
