"""The folder of calibration files: written atomically, checked thoroughly when read."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

from dm_calibration.calibration import Calibration, CalibrationFileError, from_columns, to_columns
from dm_calibration.store.hdf5_image import ImageError, content_hash, read_image, write_image
from dm_common.atomic_write import StoreError, storing, write_whole
from dm_common.errors import UnknownNameError
from dm_common.state_files import file_stem

SUFFIX = ".h5"
#: Prefixes of the raw data (maps, sampling points, mirror), which never change once a calibration is stored.
_RAW = ("maps/", "points/", "mirror/")
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


@dataclass(frozen=True)
class Entry:
    """One file of the folder: its calibration, or the reason why it cannot be read."""

    id: str
    file: Path
    calibration: Calibration | None
    remark: str


def new_id(mirror_name: str, serial: str, created_ns: int) -> str:
    """An id made from mirror, serial number and time (UTC)."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(created_ns * 1e-9))
    return "_".join(filter(None, (_stem(mirror_name), _stem(serial), stamp)))


def _stem(text: str) -> str:
    """`text` reduced to characters that are safe in a file name."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-")[:32]


class CalibrationStore:
    """Calibrations of one folder, one file ``<id>.h5`` each.

    Args:
        written: called with each file that is stored or replaced.
    """

    def __init__(self, folder: str | Path, written: Callable[[Path], None] = lambda file: None) -> None:
        self.folder = Path(folder).expanduser()
        self._written = written

    def new_id(self, mirror_name: str, serial: str, created_ns: int) -> str:
        """An id that no file of the folder has: mirror, serial number, time (UTC), and a number when needed."""
        stem = new_id(mirror_name, serial, created_ns)
        candidates = chain((stem,), (f"{stem}-{number}" for number in count(2)))
        return next(identifier for identifier in candidates if not self._file(identifier).exists())

    def save(self, calibration: Calibration) -> Path:
        """Write `calibration` to ``<id>.h5``: to a temporary file beside it, which is then renamed in one step.

        Raises:
            StoreError: disk full, read-only, id taken, ...; the folder is unchanged.
            ValueError: the id is not a safe file stem.
        """
        if not _ID.fullmatch(calibration.id):
            allowed = "must be 1 to 128 letters, digits, '.', '_' or '-', with no leading dot"
            raise ValueError(f"calibration id = {calibration.id!r}: {allowed}")
        target = self._file(calibration.id)
        if target.exists():
            raise StoreError(f"calibration {calibration.id} exists already; it is not overwritten")
        self._write(target, calibration)
        return target

    def replace(self, calibration: Calibration) -> Path:
        """Replace the file of `calibration` in one step: the old file stays until the new one is complete.

        Raises:
            StoreError: disk full, read-only, raw data differ from those in the file, ...; the old file is unchanged.
            UnknownNameError: there is no such file.
            CalibrationFileError: the old file is damaged and is not overwritten.
        """
        target = self.find(calibration.id)
        if raw_hash(self.load(calibration.id)) != raw_hash(calibration):
            raise StoreError(f"calibration {calibration.id}: its raw data differ from those in the file; not replaced")
        self._write(target, calibration)
        return target

    def _write(self, target: Path, calibration: Calibration) -> None:
        image = write_image(*to_columns(calibration))
        with storing(f"calibration {calibration.id} was not stored in {self.folder}"):
            write_whole(target, image)
        self._written(target)

    def note_in_use(self, calibration: Calibration) -> None:
        """Record on disk, for the next start, that the mirror uses `calibration`. Raises StoreError."""
        if self.last_in_use(calibration.mirror_serial) != calibration.id:
            with storing(f"{calibration.id} is in use, but could not be noted for the next start"):
                write_whole(self._in_use(calibration.mirror_serial), calibration.id.encode())

    def last_in_use(self, serial: str) -> str:
        """The id of the calibration that a mirror used last; "" = not known."""
        try:
            noted = self._in_use(serial).read_text().strip()
        except (OSError, UnicodeDecodeError):
            return ""
        return noted if _ID.fullmatch(noted) else ""

    def _in_use(self, serial: str) -> Path:
        return self.folder / f"{file_stem('in_use', serial)}.txt"

    def load(self, name: str) -> Calibration:
        """The calibration with the id `name`, or in the file `name` of this folder.

        Raises:
            UnknownNameError: no such file, or a name that leads out of the folder.
            CalibrationFileError: the file is damaged, foreign, or of another schema.
        """
        file = self.find(name)
        try:
            calibration = from_columns(*read_image(file))
        except (ImageError, CalibrationFileError) as error:
            raise CalibrationFileError(f"{file.name}: {error}") from error
        if calibration.id != file.name.removesuffix(SUFFIX):
            raise CalibrationFileError(f"{file.name}: holds the calibration {calibration.id}; was the file renamed?")
        return calibration

    def find(self, name: str) -> Path:
        """The file of the calibration with the id or file name `name`.

        Raises:
            UnknownNameError: no such file, or a name that leads out of the folder.
        """
        try:
            path = Path(name).expanduser()
        except RuntimeError as error:
            raise UnknownNameError(f"calibration {name!r}: {error}") from error
        if path.name != name:  # a path is accepted only if it names a file of this folder
            inside = path.suffix == SUFFIX and path.parent.resolve() == self.folder.resolve()
            if not inside:
                raise UnknownNameError(f"calibration {name!r}: must be an id or a file of {self.folder}")
        identifier = path.name.removesuffix(SUFFIX)
        if not _ID.fullmatch(identifier):
            raise UnknownNameError(f"calibration {name!r}: not an id")
        file = self._file(identifier)
        if not file.is_file():
            raise UnknownNameError(f"calibration {identifier!r}: no such file in {self.folder}")
        if file.resolve().parent != self.folder.resolve():
            raise UnknownNameError(f"calibration {identifier!r}: the file is a link out of {self.folder}")
        return file

    def entries(self) -> list[Entry]:
        """All files of the folder, newest first by creation; damaged ones, with the reason, by modification time."""
        listed = []
        for file in self.folder.glob(f"*{SUFFIX}") if self.folder.is_dir() else []:
            if file.name.startswith("."):
                continue
            identifier = file.name.removesuffix(SUFFIX)
            age_ns = 0
            try:
                age_ns = file.stat().st_mtime_ns
                calibration = self.load(identifier)
                listed.append((calibration.created_ns, Entry(identifier, file, calibration, "")))
            except (CalibrationFileError, UnknownNameError, OSError) as error:
                listed.append((age_ns, Entry(identifier, file, None, str(error))))
        listed.sort(key=lambda item: (item[0], item[1].id), reverse=True)
        return [entry for _, entry in listed]

    def _file(self, identifier: str) -> Path:
        return self.folder / f"{identifier}{SUFFIX}"


def raw_hash(calibration: Calibration) -> str:
    """Hash over the raw data, to compare them bit by bit."""
    columns = to_columns(calibration)[0]
    return content_hash({name: values for name, values in columns.items() if name.startswith(_RAW)}, {})
