"""Getting new map files from the instrument: by a trigger command, or from the watched folder. Independent of ROS."""

import math
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from dm_calibration.acquisition.folder_watch import FileEvent, FolderWatch, Signature
from dm_calibration.acquisition.inotify import ClosedFiles
from dm_calibration.acquisition.trigger import PLACEHOLDER, run_trigger
from dm_calibration.map_files import MapFileError, NoValidPixelsError, SurfaceMap
from dm_calibration.map_files.datx_structure import as_text
from dm_common.errors import ErrorCode, Refusal
from dm_common.measurement import Measurement
from dm_common.values import parameter, real, text, texts

_POLL_OUTPUT_S = 0.01
#: Age of a watched file's modification time, ns, above which it is not believed: clocks of two machines may differ.
_RECENT_NS = 60 * 10**9
#: Time after which an unreadable folder causes a warning, s: the program that creates it may still be starting.
FOLDER_PATIENCE_S = 5.0


@dataclass(frozen=True)
class AcquisitionSettings:
    """Where maps come from; `folder`: the parameter `watch_folder`, None = no folder is watched."""

    folder: Path | None
    patterns: Sequence[str] = parameter(
        texts(["*.dat", "*.datx", "*.asc", "*.xyz", "*.fits", "*.h5", "*.4D"]),
        "Names of the files to take from watch_folder, as shell patterns.",
        name="file_pattern",
    )
    stable_time: float = parameter(
        real(0.5, 0.02, 3600.0, "s"), "Time for which a file's size and modification time must not change."
    )
    trigger_command: Sequence[str] = parameter(
        texts([]),
        "Command that makes the instrument take a map, as an argument list (no shell); {path} in an argument is "
        "replaced by the path in watch_folder to write to. Empty = measure waits for the next new file.",
    )
    trigger_suffix: str = parameter(
        text(".datx"), "Ending of the file name that replaces {path}.", name="trigger_output_suffix"
    )
    trigger_timeout: float = parameter(real(30.0, 0.1, 3600.0, "s"), "Time limit of trigger_command.")
    trigger_exposure: float = parameter(
        real(0.5, 0.0, 1.0),
        "When the map is exposed, as a fraction of the run time of trigger_command: 0 = at its start.",
    )
    file_delay: float = parameter(
        real(0.0, 0.0, 3600.0, "s"),
        "For instruments that measure continuously: time from the start of an exposure to the end of its file. A file "
        "that ends sooner after a request shows the earlier shape, and measure waits for the next one.",
    )

    def __post_init__(self) -> None:
        """Raise ValueError when the settings contradict each other."""
        if self.trigger_command and self.folder is None:
            raise ValueError("trigger_command needs watch_folder, where its map files arrive; watch_folder is empty")
        if self.trigger_command and not self.trigger_command[0]:
            raise ValueError("trigger_command = ['', ...]: the first entry must name a program")
        if not re.fullmatch(r"(\.[A-Za-z0-9_-]{1,16}){1,2}", self.trigger_suffix):
            raise ValueError(
                f"trigger_output_suffix = {self.trigger_suffix!r}: must be an ending such as .datx, and name no folder"
            )


class Acquisition:
    """Watches the folder in a thread, and takes measurements on request.

    A file that a request waits for goes to that request only; every other new file is passed to `on_file`.
    """

    def __init__(
        self,
        settings: AcquisitionSettings,
        read: Callable[[Path], tuple[SurfaceMap, Measurement]],
        now_ns: Callable[[], int],
        on_file: Callable[[Path], None],
        on_trouble: Callable[[str], None],
    ) -> None:
        """Prepare; nothing happens before :meth:`start`.

        Args:
            read: reads a map file; raises MapFileError for files that are not (yet) complete.
            now_ns: clock for the times of measurements.
            on_file: called in the watching thread with each new file.
            on_trouble: called in that thread with each new problem: a file refused unread, or an unreadable folder.
        """
        self.settings = settings
        self.source = str(settings.folder or "only files given to ingest_file")
        self.folder_trouble = ""
        self._complain_at: float | None = None
        self._read = read
        self._now_ns = now_ns
        self._on_file = on_file
        self._on_trouble = on_trouble
        self._watch: FolderWatch | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._handover = threading.Lock()
        self._waiting: queue.SimpleQueue[Path] | None = None
        self._before: set[Signature] = set()
        self._from_ns = self._too_soon = 0  # earliest file time that counts for a request; number of earlier files
        self._numbers = count(1)

    def start(self) -> None:
        """Begin to watch; files that are in the folder now do not count as new."""
        self._stop = threading.Event()  # a new event, so that a previous thread that ends late stays stopped
        if self.settings.folder is not None:
            self._watch = FolderWatch(self.settings.folder, self.settings.patterns, self.settings.stable_time)
            self._poll(self._watch)
            watched = self._watch, self._stop
            self._thread = threading.Thread(target=self._run, args=watched, name="folder_watch", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End watching and any measurement that is under way."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(5)
            self._thread = None

    def acquire(self, timeout_s: float) -> tuple[SurfaceMap, Measurement]:
        """Trigger a measurement, or wait for the next new file when there is no trigger command.

        Returns:
            The oriented map and its measurement, stamped with the time of exposure during the trigger command, or with
            0 (not known) if the file came without a trigger.

        Raises:
            TriggerError: the trigger command failed.
            MapFileError and whatever else `read` raises: the file that arrived is unusable.
            Refusal: MAP_TIMEOUT if no new map came in time, INTERFEROMETER_INACTIVE if :meth:`stop` was called
                meanwhile, NOT_SUPPORTED if neither a trigger command nor a folder is configured.
        """
        watch = self._watch
        if watch is None:
            raise Refusal(
                ErrorCode.NOT_SUPPORTED, "neither trigger_command nor watch_folder is configured: use ingest_file"
            )
        deadline = time.monotonic() + timeout_s
        trigger_s = min(self.settings.trigger_timeout, timeout_s)
        if any(PLACEHOLDER in argument for argument in self.settings.trigger_command):
            output = self._new_name(watch)
            taken = self._trigger(output, trigger_s)
            surface, measured = self._expected_file(output, deadline)
        else:
            delay = 0.0 if self.settings.trigger_command else self.settings.file_delay
            if delay >= timeout_s:
                reason = f"file_delay = {delay:g} s: must be less than the time limit of a measurement, {timeout_s:g} s"
                raise Refusal(ErrorCode.MAP_TIMEOUT, reason)
            with self._arrivals(watch, delay) as arrivals:
                taken = self._trigger(None, trigger_s) if self.settings.trigger_command else 0
                surface, measured = self._next_file(watch, arrivals, deadline)
        return surface, replace(measured, stamp_ns=taken)

    def _trigger(self, output: Path | None, timeout_s: float) -> int:
        """Run the trigger command; return the time of exposure, ns."""
        began = self._now_ns()
        run_trigger(self.settings.trigger_command, output, timeout_s, self._stop)
        self._check_stopped()
        return began + round(self.settings.trigger_exposure * (self._now_ns() - began))

    def _check_stopped(self) -> None:
        if self._stop.is_set():
            raise Refusal(
                ErrorCode.INTERFEROMETER_INACTIVE, "the interferometer was deactivated during the measurement"
            )

    def _new_name(self, watch: FolderWatch) -> Path:
        """A new file name that the watch ignores: only the measurement that asks for the file takes it."""
        if not watch.folder.is_dir():
            raise Refusal(ErrorCode.MAP_TIMEOUT, f"watch_folder = {str(watch.folder)!r}: no such folder")
        output = watch.folder / f"measure_{time.time_ns()}_{next(self._numbers)}{self.settings.trigger_suffix}"
        watch.ignore(output)
        return output

    def _expected_file(self, path: Path, deadline: float) -> tuple[SurfaceMap, Measurement]:
        """Read the file that the trigger command had to write, which may still be growing."""
        seen: tuple[int, int] | None = None
        since = time.monotonic()
        trouble: MapFileError | None = None
        while True:
            self._check_stopped()
            now = time.monotonic()
            if path.is_symlink():
                raise MapFileError(f"{path}: a symbolic link, must be a regular file")
            if path.exists():
                status = path.stat()
                if (status.st_size, status.st_mtime_ns) != seen:
                    seen, since = (status.st_size, status.st_mtime_ns), now
                    try:
                        return self._read(path)
                    except NoValidPixelsError:
                        raise
                    except MapFileError as error:
                        trouble = error
                elif trouble is not None and now - since >= self.settings.stable_time:
                    raise trouble
            if now >= deadline:
                text = f"the trigger command ended, but {path} did not appear in time (ending: trigger_output_suffix)"
                raise trouble or Refusal(ErrorCode.MAP_TIMEOUT, text)
            time.sleep(_POLL_OUTPUT_S)

    @contextmanager
    def _arrivals(self, watch: FolderWatch, delay: float) -> Iterator[queue.SimpleQueue[Path]]:
        """Queue that receives the next file that is written at least `delay` s from now."""
        arrivals: queue.SimpleQueue[Path] = queue.SimpleQueue()
        with self._handover:
            self._waiting, self._before, self._too_soon = arrivals, set(), 0
            self._from_ns = time.time_ns() + round(1e9 * delay) if delay else 0
            with suppress(OSError):  # the folder may appear later
                self._before = set(watch.signatures().values())
        try:
            yield arrivals
        finally:
            with self._handover:
                self._waiting = None
            while not arrivals.empty():  # the trigger failed, or the time was up: treat as any other new file
                self._on_file(arrivals.get())

    def _next_file(
        self, watch: FolderWatch, arrivals: queue.SimpleQueue[Path], deadline: float
    ) -> tuple[SurfaceMap, Measurement]:
        while True:
            self._check_stopped()
            remaining = deadline - time.monotonic()
            try:
                return self._read(arrivals.get(timeout=min(max(remaining, 0.001), 0.1)))
            except queue.Empty:
                if remaining <= 0:
                    reason = self.folder_trouble or f"no new map file in {watch.folder} in time"
                    if self._too_soon:
                        delay = self.settings.file_delay
                        reason += (
                            f"; {self._too_soon} ended less than file_delay = {delay:g} s after the request by their "
                            "times"
                        )
                    raise Refusal(ErrorCode.MAP_TIMEOUT, reason) from None

    def _run(self, watch: FolderWatch, stop: threading.Event) -> None:
        period = min(max(self.settings.stable_time / 4, 0.02), 0.25)
        due = time.monotonic() + period
        with closing(ClosedFiles(watch.folder)) as closed:
            while not stop.is_set():
                names = closed.wait(due - time.monotonic())
                events = watch.closed(names, time.monotonic())
                if time.monotonic() >= due:
                    events += self._poll(watch)
                    due = time.monotonic() + period
                for event in events:
                    if event.refused:
                        self._on_trouble(f"{as_text(event.path)}: {event.refused}")
                    else:
                        self._hand_over(event)

    def _poll(self, watch: FolderWatch) -> list[FileEvent]:
        try:
            events = watch.poll(time.monotonic())
        except OSError as error:
            self.folder_trouble = f"watch_folder = {str(watch.folder)!r} cannot be read: {error.strerror or error}"
            now = time.monotonic()
            if self._complain_at is None:
                self._complain_at = now + FOLDER_PATIENCE_S
            if now >= self._complain_at:
                self._on_trouble(self.folder_trouble)
                self._complain_at = math.inf  # only once
            return []
        self.folder_trouble, self._complain_at = "", None
        return events

    def _hand_over(self, event: FileEvent) -> None:
        with self._handover:
            # A file written before the request shows the earlier shape, however late it is noticed.
            if self._waiting is not None and event.signature not in self._before:
                if min(event.signature.modified_ns, time.time_ns()) >= self._from_ns:  # file times may be ahead
                    self._waiting.put(event.path)
                    self._waiting = None  # one file per request
                    return
                self._too_soon += 1
        self._on_file(event.path)


def measured_ns(surface: SurfaceMap, now_ns: int, believe_header: bool) -> int:
    """When the map in a file was measured, ns: as the file says if that is plausible, else `now_ns`.

    Args:
        believe_header: use the time in the file, however old; otherwise its modification time, if recent.
    """
    if believe_header and surface.time_stamp is not None and 0 < surface.time_stamp * 1e9 <= now_ns:
        return round(surface.time_stamp * 1e9)
    oldest = 0 if believe_header else now_ns - _RECENT_NS
    return surface.written_ns if oldest < surface.written_ns <= now_ns else now_ns
