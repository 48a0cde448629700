"""Many damaged files for every reader, each read by a child process with a memory limit and watched by a clock."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fault_injection.fuzz.classify import Verdict

#: A file that is not checked within this time counts as a hang; the readers give up long before, also on a busy machine
#: [s].
TIME_LIMIT_S = 120.0
#: Time for a worker to start [s].
START_LIMIT_S = 120.0
_KEPT_FINDINGS = 100


@dataclass
class FuzzResult:
    """What became of the damaged files of one format.

    Attributes:
        files: damaged files that were given to the reader.
        crashes: the process died, raised what no reader should, or asked for memory beyond its limit.
        hangs: files that took longer than TIME_LIMIT_S.
        wrong_maps: files that were read without an error but give a map that the damage does not explain.
        refused, intact, other_samples, other_header: the legal outcomes, see :mod:`fault_injection.fuzz.classify`.
        findings: what went wrong, with the file's number.
    """

    files: int = 0
    crashes: int = 0
    hangs: int = 0
    wrong_maps: int = 0
    refused: int = 0
    intact: int = 0
    other_samples: int = 0
    other_header: int = 0
    findings: list[dict[str, Any]] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return dict(vars(self))

    @property
    def harm(self) -> int:
        return self.crashes + self.hangs + self.wrong_maps

    def _count(self, verdicts: Counter[str]) -> None:
        self.files += verdicts.total()
        self.refused += verdicts[Verdict.REFUSED]
        self.intact += verdicts[Verdict.INTACT]
        self.other_samples += verdicts[Verdict.OTHER_SAMPLES]
        self.other_header += verdicts[Verdict.OTHER_HEADER]
        self.wrong_maps += verdicts[Verdict.WRONG_MAP]
        self.crashes += verdicts[Verdict.EXCEPTION] + verdicts[Verdict.MEMORY]


def fuzz(
    name: str,
    files: int,
    folder: Path,
    seed: int = 1,
    first: int = 0,
    deadline: float = float("inf"),
    progress: Callable[[int], None] = lambda count: None,
) -> FuzzResult:
    """Give the reader of the format `name` damaged files `first` to `first + files - 1` of `seed`.

    A worker process reads one after another; when it dies or hangs, a new one goes on with the file after that.

    Args:
        folder: an existing folder of this call's own, for the files and findings.
        deadline: monotonic time at which to stop, s.
        progress: called with the number of files checked since the last call.
    """
    result = FuzzResult()
    number, end = first, first + files
    while number < end and time.monotonic() < deadline:
        number = _run_worker(name, seed, number, end, folder, deadline, result, progress)
    findings = folder / "findings.jsonl"
    if findings.exists():
        result.findings += [json.loads(line) for line in findings.read_text().splitlines()]
        findings.unlink()
    del result.findings[_KEPT_FINDINGS:]
    return result


def _run_worker(
    name: str,
    seed: int,
    start: int,
    end: int,
    folder: Path,
    deadline: float,
    result: FuzzResult,
    progress: Callable[[int], None],
) -> int:
    """Run one worker until it is done, dies, hangs or the time is up; return the number of the next file."""
    arguments = [name, str(seed), str(start), str(end), str(folder)]
    log = folder / "worker.log"
    with log.open("wb") as output:
        worker = subprocess.Popen(
            [sys.executable, "-m", "fault_injection.fuzz.fuzz_worker", *arguments],
            stdout=subprocess.PIPE,
            stderr=output,
        )
    assert worker.stdout is not None
    number, limit, hung = start, START_LIMIT_S, False
    try:
        while time.monotonic() < deadline:
            if not select.select([worker.stdout], [], [], limit)[0]:
                hung = True
                break
            letters = os.read(worker.stdout.fileno(), 65536).decode()
            if not letters:
                break
            limit = TIME_LIMIT_S
            result._count(Counter(letters))
            number += len(letters)
            progress(len(letters))
        else:
            return end
    finally:
        if hung or time.monotonic() >= deadline:
            worker.kill()
        status = worker.wait()
        worker.stdout.close()
    if number == end and status == 0:
        return end
    words = log.read_text(errors="replace")[-500:]
    if number == start and status == 1 and not hung:
        raise RuntimeError(f"the fuzzer's worker cannot start: {words}")
    result.files += 1
    result.hangs += hung
    result.crashes += not hung
    what = f"no answer within {limit:g} s" if hung else f"the process ended with status {status}"
    result.findings.append({"format": name, "number": number, "verdict": "HANG" if hung else "DIED", "words": what})
    progress(1)
    return number + 1


def fuzz_all(
    files: dict[str, int],
    folder: Path,
    seed: int = 1,
    deadline: float = float("inf"),
    progress: Callable[[str, int], None] = lambda name, count: None,
    workers: int = 2,
) -> dict[str, FuzzResult]:
    """:func:`fuzz` for several formats, `workers` at a time.

    Args:
        files: number of damaged files by format.
    """

    def run(name: str) -> FuzzResult:
        own = folder / name
        own.mkdir(parents=True, exist_ok=True)
        return fuzz(name, files[name], own, seed, 0, deadline, lambda count: progress(name, count))

    with ThreadPoolExecutor(workers) as pool:
        return dict(zip(files, pool.map(run, files), strict=True))
