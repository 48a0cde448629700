"""Trigger commands and waiting for files: real processes, real files, real time (but no timed assertions)."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dm_calibration.acquisition import acquisition
from dm_calibration.acquisition.acquisition import Acquisition, AcquisitionSettings
from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.acquisition.trigger import TriggerError, run_trigger
from dm_calibration.map_files import MapFileError
from dm_common.errors import ErrorCode, Refusal, error_code
from map_fixtures import dat_bytes, disc_counts
from waiting import wait_until

MAP = dat_bytes(disc_counts(40))


def python(code: str, *arguments: str) -> list[str]:
    return [sys.executable, "-S", "-c", code, *arguments]


class WatchedFolder:
    """An Acquisition on a folder, with what it reported."""

    def __init__(self, folder: Path | None, command: list[str] | None = None, **settings: Any) -> None:
        self.files: list[Path] = []
        self.troubles: list[str] = []
        ingest = Ingest()
        self.acquisition = Acquisition(
            AcquisitionSettings(folder, ["*.dat"], 0.1, command or [], ".dat", **settings),
            lambda path: ingest.read(path, IngestSettings()),
            time.time_ns,
            self.files.append,
            self.troubles.append,
        )
        self.acquisition.start()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Any]:
    made: list[WatchedFolder] = []

    def make(*arguments: Any, **settings: Any) -> WatchedFolder:
        made.append(WatchedFolder(*arguments, **settings))
        return made[-1]

    yield make
    for one in made:
        one.acquisition.stop()


def test_command_that_is_told_its_output(tmp_path: Path, bench: Any) -> None:
    (tmp_path / "source").write_bytes(MAP)
    code = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
    one = bench(tmp_path, python(code, str(tmp_path / "source"), "{path}"))
    before = time.time_ns()
    surface, measured = one.acquisition.acquire(20)
    assert Path(surface.file).parent == tmp_path
    assert before < measured.stamp_ns < time.time_ns()
    (tmp_path / "marker.dat").write_bytes(MAP)
    wait_until(lambda: one.files, what="the marker, which stands still later than the triggered file")
    assert one.files == [tmp_path / "marker.dat"]


def test_output_that_grows_after_the_command_has_ended(tmp_path: Path, bench: Any) -> None:
    (tmp_path / "source").write_bytes(MAP)
    child = (
        "import sys, time\ndata = open(sys.argv[1], 'rb').read()\nout = open(sys.argv[2], 'wb')\n"
        "for start in range(0, len(data), 2000): out.write(data[start:start + 2000]); out.flush(); time.sleep(0.02)"
    )
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-S', '-c', {child!r}, *sys.argv[1:]])"
    one = bench(tmp_path, python(code, str(tmp_path / "source"), "{path}"))
    assert one.acquisition.acquire(20)[0].sag.shape == (40, 40)


def test_no_shell_ever_sees_the_arguments(tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    run_trigger(
        python("import sys; open(sys.argv[1], 'w').write(sys.argv[2])", str(seen), "$(id); `id` > {path} & *"),
        tmp_path / "a b.dat",
        20,
        threading.Event(),
    )
    assert seen.read_text() == f"$(id); `id` > {tmp_path / 'a b.dat'} & *"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            python("import sys; sys.exit('laser is off')", "{path}"),
            "ended with status 1; its output ends: laser is off",
        ),
        (["/nonexistent/program", "{path}"], "'/nonexistent/program' cannot be started"),
    ],
)
def test_failing_command(tmp_path: Path, bench: Any, command: list[str], words: str) -> None:
    with pytest.raises(TriggerError, match=words):
        bench(tmp_path, command).acquisition.acquire(20)


@pytest.mark.slow
def test_hanging_command_is_ended_with_its_children(tmp_path: Path) -> None:
    child = "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(600)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-S', '-c', {child!r}, sys.argv[1]])"
    with pytest.raises(TriggerError, match=r"did not end within 1\.5 s"):
        run_trigger(python(code, str(tmp_path / "pid")), None, 1.5, threading.Event())
    process = Path("/proc") / (tmp_path / "pid").read_text()
    wait_until(
        lambda: not process.exists() or "Z" in (process / "stat").read_text().split()[2], what="the end of the child"
    )


@pytest.mark.slow
def test_command_that_writes_nothing(tmp_path: Path, bench: Any) -> None:
    with pytest.raises(Refusal, match="did not appear in time"):
        bench(tmp_path, python("", "{path}")).acquisition.acquire(1.0)


def test_command_that_writes_half_a_map(tmp_path: Path, bench: Any) -> None:
    (tmp_path / "source").write_bytes(MAP[:-7])
    code = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
    with pytest.raises(MapFileError, match="truncated"):
        bench(tmp_path, python(code, str(tmp_path / "source"), "{path}")).acquisition.acquire(20)


def test_command_whose_file_is_found_in_the_folder(tmp_path: Path, bench: Any) -> None:
    (tmp_path / "source").write_bytes(MAP)
    code = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
    one = bench(tmp_path, python(code, str(tmp_path / "source"), str(tmp_path / "from_instrument.dat")))
    surface, measured = one.acquisition.acquire(20)
    assert surface.file == str(tmp_path / "from_instrument.dat")
    assert measured.stamp_ns
    assert one.files == []


@pytest.mark.slow
def test_a_map_of_a_command_that_fails_afterwards_is_a_file_like_any_other(tmp_path: Path, bench: Any) -> None:
    (tmp_path / "source").write_bytes(MAP)
    code = "import shutil, sys, time; shutil.copy(sys.argv[1], sys.argv[2]); time.sleep(1); sys.exit(3)"
    one = bench(tmp_path, python(code, str(tmp_path / "source"), str(tmp_path / "from_instrument.dat")))
    with pytest.raises(TriggerError, match="status 3"):
        one.acquisition.acquire(20)
    wait_until(lambda: one.files, what="the map")
    assert one.files == [tmp_path / "from_instrument.dat"]


def test_without_a_command_the_next_new_file_is_the_measurement(tmp_path: Path, bench: Any) -> None:
    one = bench(tmp_path)
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(one.acquisition.acquire(20)))
    thread.start()
    time.sleep(0.05)
    (tmp_path / "by_hand.dat").write_bytes(MAP)
    thread.join(20)
    surface, measured = results[0]
    assert surface.file == str(tmp_path / "by_hand.dat")
    assert not measured.stamp_ns, "nobody knows it"
    (tmp_path / "next.dat").write_bytes(MAP)
    wait_until(lambda: one.files, what="the next file")
    assert one.files == [tmp_path / "next.dat"]


def test_a_file_from_before_the_request_is_not_its_measurement_however_late_it_is_noticed(
    tmp_path: Path, bench: Any
) -> None:
    one = bench(tmp_path)
    busy, go_on, results = threading.Event(), threading.Event(), []

    def read_slowly(path: Path) -> None:
        one.files.append(path)
        busy.set()
        go_on.wait(20)

    one.acquisition._on_file = read_slowly
    (tmp_path / "first.dat").write_bytes(MAP)
    busy.wait(20)
    (tmp_path / "before.dat").write_bytes(MAP)
    thread = threading.Thread(target=lambda: results.append(one.acquisition.acquire(20)))
    thread.start()
    wait_until(lambda: one.acquisition._waiting is not None, what="the request")
    go_on.set()
    wait_until(lambda: len(one.files) == 2 or results, what="the file from before")
    (tmp_path / "after.dat").write_bytes(MAP)
    thread.join(20)
    assert results[0][0].file == str(tmp_path / "after.dat")
    assert one.files == [tmp_path / "first.dat", tmp_path / "before.dat"]


@pytest.mark.slow
def test_what_an_instrument_exposed_before_the_request_is_passed_over(tmp_path: Path, bench: Any) -> None:
    """It measures on by itself, and ends a file 0.3 s after the exposure of its map."""
    one, results = bench(tmp_path, file_delay=0.3), []
    thread = threading.Thread(target=lambda: results.append(one.acquisition.acquire(20)))
    thread.start()
    wait_until(lambda: one.acquisition._waiting is not None, what="the request")
    (tmp_path / "exposed_before.dat").write_bytes(MAP)
    wait_until(lambda: one.files, what="the file that is passed over")
    time.sleep(0.4)
    (tmp_path / "exposed_after.dat").write_bytes(MAP)
    thread.join(20)
    assert results[0][0].file == str(tmp_path / "exposed_after.dat")
    assert one.files == [tmp_path / "exposed_before.dat"]


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [0.0, 60.0])
def test_files_that_all_come_too_soon_are_told(tmp_path: Path, bench: Any, ahead: float) -> None:
    """Whatever the clock of their writer says."""

    def write() -> None:
        (tmp_path / "soon").write_bytes(MAP)
        os.utime(tmp_path / "soon", times=(time.time() + ahead,) * 2)
        (tmp_path / "soon").rename(tmp_path / "soon.dat")

    one = bench(tmp_path, file_delay=1.9)
    threading.Timer(0.2, write).start()
    with pytest.raises(
        Refusal, match=r"no new map file .* in time; 1 ended less than file_delay = 1\.9 s after the request"
    ):
        one.acquisition.acquire(2.0)
    with pytest.raises(Refusal, match=r"file_delay = 1\.9 s: must be less than the time limit of a measurement, 1 s"):
        one.acquisition.acquire(1.0)


@pytest.mark.parametrize("exposed", [0.0, 1.0])
def test_a_map_counts_as_of_its_exposure_in_the_run_of_the_command(tmp_path: Path, bench: Any, exposed: float) -> None:
    code = "import sys, time; open(sys.argv[2], 'wb').write(open(sys.argv[1], 'rb').read()); time.sleep(0.05)"
    (tmp_path / "source").write_bytes(MAP)
    command = python(code, str(tmp_path / "source"), "{path}")
    one = bench(tmp_path, command, trigger_exposure=exposed)
    surface, measured = one.acquisition.acquire(20)
    assert (measured.stamp_ns > surface.written_ns) == bool(exposed)


def test_no_new_file_in_time(tmp_path: Path, bench: Any) -> None:
    with pytest.raises(Refusal, match="no new map file"):
        bench(tmp_path).acquisition.acquire(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("patience", "complaints"), [(0.1, 1), (20.0, 0)])
def test_folder_that_does_not_exist_is_waited_for_and_reported_once_when_that_takes_long(
    tmp_path: Path, bench: Any, monkeypatch: pytest.MonkeyPatch, patience: float, complaints: int
) -> None:
    monkeypatch.setattr(acquisition, "FOLDER_PATIENCE_S", patience)
    one = bench(tmp_path / "later")
    with pytest.raises(Refusal, match="cannot be read: No such file"):
        one.acquisition.acquire(0.5)
    assert len(one.troubles) == complaints
    (tmp_path / "later").mkdir()
    wait_until(lambda: not one.acquisition.folder_trouble, what="the folder is watched")
    (tmp_path / "later" / "a.dat").write_bytes(MAP)
    wait_until(lambda: one.files, what="the first file")


def test_stopping_ends_a_measurement(tmp_path: Path, bench: Any) -> None:
    one = bench(tmp_path, python("import time; time.sleep(600)", "{path}"))
    errors: list[Exception] = []

    def measure() -> None:
        try:
            one.acquisition.acquire(300)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=measure)
    thread.start()
    time.sleep(0.2)
    one.acquisition.stop()
    thread.join(20)
    assert [error_code(error) for error in errors] == [ErrorCode.INTERFEROMETER_INACTIVE]


def test_a_thread_that_is_late_to_end_takes_no_files_after_a_new_start(
    tmp_path: Path, bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, late = bench(tmp_path), threading.enumerate()[-1]
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "join", lambda *_: None)  # a file that takes longer to read than it is waited
        one.acquisition.stop()
    one.acquisition.start()
    late.join(5)
    assert late.name == "folder_watch" and not late.is_alive()


def test_settings_that_contradict_each_other(bench: Any) -> None:
    with pytest.raises(ValueError, match="trigger_command needs watch_folder"):
        bench(None, ["trigger"])
    with pytest.raises(Refusal, match="neither"):
        bench(None).acquisition.acquire(1)
