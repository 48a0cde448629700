"""The process that reads damaged files: started by :mod:`fault_injection.fuzz.fuzz`, and expendable.

`python -m fault_injection.fuzz.fuzz_worker FORMAT SEED START STOP FOLDER` writes one letter per file to standard
output (see classify.Verdict), and what went wrong in words to FOLDER/findings.jsonl.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

from dm_calibration.calibration import CalibrationFileError, to_columns
from dm_calibration.map_files import MapFileError, read_map
from dm_calibration.store.calibration_store import CalibrationStore
from dm_calibration.store.hdf5_image import content_hash
from fault_injection.fuzz.classify import Verdict, classify
from fault_injection.fuzz.mutations import Mutation, mutate
from fault_injection.fuzz.reference_files import CALIBRATION_ID, XYZ_UNIT, ReferenceFile, reference_file

#: Address space that a reader may take beyond what this process had before the first damaged file [bytes].
MEMORY = 256 << 20

Reader = Callable[[Mutation], tuple[Verdict, str]]


def map_reader(file: ReferenceFile, folder: Path) -> Reader:
    """Reads and classifies damaged map files."""
    path = folder / f"damaged{file.suffix}"
    path.write_bytes(file.content)
    whole = read_map(path, xyz_unit=XYZ_UNIT)

    def read(mutation: Mutation) -> tuple[Verdict, str]:
        path.write_bytes(mutation.content)
        try:
            found = read_map(path, xyz_unit=XYZ_UNIT)
        except MapFileError as error:
            return _refused(error)
        f"{found.instrument}{found.serial}".encode()  # they are published: must be text
        return classify(file, whole, mutation, found), ""

    return read


def calibration_reader(file: ReferenceFile, folder: Path) -> Reader:
    """Loads damaged calibration files."""
    store = CalibrationStore(folder)
    path = folder / f"{CALIBRATION_ID}{file.suffix}"
    path.write_bytes(file.content)
    whole = content_hash(*to_columns(store.load(CALIBRATION_ID)))

    def read(mutation: Mutation) -> tuple[Verdict, str]:
        path.write_bytes(mutation.content)
        try:
            found = store.load(CALIBRATION_ID)
        except CalibrationFileError as error:
            return _refused(error)
        return (Verdict.INTACT if content_hash(*to_columns(found)) == whole else Verdict.WRONG_MAP), ""

    return read


def _refused(error: BaseException) -> tuple[Verdict, str]:
    """A refusal, unless it hides that memory ran out: then the reader asked for more than a file warrants."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return Verdict.MEMORY, str(error)
        cause = cause.__cause__ or cause.__context__
    return Verdict.REFUSED, ""


def limit_memory() -> None:
    """From now on this process may take MEMORY more than it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(arguments: list[str]) -> int:
    """Read the files START to STOP - 1."""
    name, seed, start, stop, folder = arguments[0], *map(int, arguments[1:4]), Path(arguments[4])
    warnings.simplefilter("ignore")
    file = reference_file(name)
    read = (calibration_reader if name == "calibration" else map_reader)(file, folder)
    limit_memory()
    with (folder / "findings.jsonl").open("a") as findings:
        for number in range(start, stop):
            mutation = mutate(file, seed, number)
            try:
                verdict, words = read(mutation)
            except MemoryError as error:
                verdict, words = Verdict.MEMORY, f"MemoryError: {error}"
            except Exception as error:
                verdict, words = Verdict.EXCEPTION, f"{type(error).__name__}: {error}"
            if verdict in (Verdict.WRONG_MAP, Verdict.EXCEPTION, Verdict.MEMORY):
                entry = {"format": name, "number": number, "mutation": mutation.kind, "verdict": verdict.name}
                findings.write(json.dumps(entry | {"words": words[:500]}) + "\n")
                findings.flush()
            os.write(1, verdict.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
