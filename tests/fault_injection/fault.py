"""Faults that are injected again and again, and what they cost: the registry of `./dm faults`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from statistics import median
from typing import Any

from studies.network_namespaces import NotPermittedError


@dataclass
class FaultRecord:
    """What one kind of fault did.

    Attributes:
        injected: times.
        limit_violations: frames at the emulated electronics beyond a limit of its monitor.
        lost: what was accepted and neither carried out nor reported as failed.
        recovery_s: per injection, seconds from the end of the fault until a new command stood at the actuators.
        remarks: what went wrong, in words.
        skipped: why this machine does not let the fault be injected, in words; "" = it does.
    """

    name: str
    injected: int = 0
    limit_violations: int = 0
    lost: int = 0
    recovery_s: list[float] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    skipped: str = ""

    @property
    def harmless(self) -> bool:
        return bool(self.injected or self.skipped) and not self.limit_violations and not self.lost

    def figures(self) -> dict[str, Any]:
        """For JSON; null where nothing was measured."""
        return {
            "name": self.name,
            "injected": self.injected,
            "limit_violations": self.limit_violations,
            "lost": self.lost,
            "recovery_s_p50": median(self.recovery_s) if self.recovery_s else None,
            "recovery_s_max": max(self.recovery_s, default=None),
            "remarks": self.remarks[:20],
            "skipped": self.skipped or None,
        }


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    Attributes:
        name: as in `--faults`.
        words: one line for a person.
        run: run(folder, domain, random, record) makes its own processes, injects the fault at least once, adds to the
            record, and leaves nothing running.
    """

    name: str
    words: str
    run: Callable[[Path, int, Random, FaultRecord], None]


def run_faults(
    faults: Sequence[Fault],
    folder: Path,
    domain: int,
    seed: int = 1,
    deadline: float = 0.0,
    progress: Callable[[str], None] = lambda name: None,
) -> list[FaultRecord]:
    """Run every fault once, then again in turn until `deadline` (monotonic, s).

    A run that ends with an exception counts as lost, with the reason among the remarks: a promise was not kept.
    """
    records = [FaultRecord(fault.name) for fault in faults]
    turn = 0
    while turn == 0 or time.monotonic() < deadline:
        for fault, record in zip(faults, records, strict=True):
            if turn and time.monotonic() >= deadline:
                break
            progress(fault.name)
            random = Random(f"{fault.name}/{seed}/{turn}")
            try:
                fault.run(folder / f"{fault.name}-{turn}", domain, random, record)
            except NotPermittedError as reason:
                record.skipped = str(reason)
            except Exception as error:
                record.lost += 1
                record.remarks.append(f"{type(error).__name__}: {error}")
        turn += 1
    return records
