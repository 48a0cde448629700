"""What a new driver knows of the one before it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dm_driver.last_shape import LastShape

SHAPE = np.linspace(-1, 1, 37)


def test_the_newest_note_is_found_by_the_next_process(tmp_path: Path) -> None:
    path = tmp_path / "new" / "unit.shape"
    first = LastShape(path, 37)
    assert first.load() is None
    for scale in (0.1, 0.2, 0.3):
        first.note(scale * SHAPE)  # never closed: killed
    second = LastShape(path, 37)
    found = second.load()
    assert found is not None and np.array_equal(found, 0.3 * SHAPE)
    second.note(0.4 * SHAPE)
    again = LastShape(path, 37).load()
    assert again is not None and np.array_equal(again, 0.4 * SHAPE)


def test_a_torn_note_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "unit.shape"
    record = LastShape(path, 37)
    record.note(0.1 * SHAPE)
    half = len(path.read_bytes())
    record.note(0.2 * SHAPE)
    content = bytearray(path.read_bytes())
    newest = 0 if len(content) == half else content.index(np.float64(0.2 * SHAPE[0]).tobytes())
    content[newest + 50] ^= 1
    path.write_bytes(content)
    found = LastShape(path, 37).load()
    assert found is not None and np.array_equal(found, 0.1 * SHAPE)


@given(content=st.binary(max_size=1000))
def test_no_content_is_taken_for_a_note(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "garbage.shape"
    path.write_bytes(content)
    assert LastShape(path, 37).load() is None


def test_another_number_of_actuators_is_another_mirror(tmp_path: Path) -> None:
    path = tmp_path / "unit.shape"
    LastShape(path, 37).note(SHAPE)
    assert LastShape(path, 19).load() is None


def test_no_folder_keeps_nothing() -> None:
    nothing = LastShape(None, 37)
    nothing.note(SHAPE)
    assert nothing.load() is None


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "unit.shape").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError):
        LastShape(tmp_path / "unit.shape", 37)
    assert not (tmp_path / "elsewhere").exists()


def test_a_full_disk_is_found_when_the_record_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    opened = len(list(Path("/proc/self/fd").iterdir()))
    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", full)
        with pytest.raises(OSError, match="No space left"):
            LastShape(tmp_path / "unit.shape", 37)
    assert len(list(Path("/proc/self/fd").iterdir())) == opened, "each attempt to configure would keep a file open"
    record = LastShape(tmp_path / "unit.shape", 37)
    monkeypatch.setattr(os, "pwrite", lambda *_: 10)  # bytes: less than was given
    with pytest.raises(OSError, match="No space left"):
        record.note(SHAPE)


@pytest.mark.parametrize(("one", "other"), [(37, 7), (7, 37)])
def test_what_was_noted_before_another_number_of_actuators_is_out_of_date(tmp_path: Path, one: int, other: int) -> None:
    path = tmp_path / "unit.shape"
    for _ in range(3):
        LastShape(path, one).note(np.full(one, 4000.0))
    assert LastShape(path, other).load() is None
    assert LastShape(path, one).load() is not None, "a driver that sent nothing changes nothing"
    LastShape(path, other).note(np.full(other, 60000.0))
    assert LastShape(path, one).load() is None
    found = LastShape(path, other).load()
    assert found is not None and (found == 60000.0).all()
