"""Ports and folder of a virtual bench."""

from pathlib import Path

import pytest

from dm_tools.demo.demo_bench import free_ports, make_empty, usable_folder


def test_ports_that_nobody_has_bound_yet_are_not_handed_out_again() -> None:
    drawn = [port for _ in range(50) for port in free_ports(4)]
    assert len(set(drawn)) == len(drawn)


def test_a_demo_empties_its_own_folder_and_no_other(tmp_path: Path) -> None:
    mine, made, empty = (tmp_path / name for name in ("mine", "made", "empty"))
    for folder in (mine, empty):
        folder.mkdir()
    (mine / "thesis.tex").write_text("years")
    (tmp_path / "file").touch()
    for taken in (mine, tmp_path, tmp_path / "file"):
        with pytest.raises(ValueError, match="is there, and not of a demo"):
            usable_folder(taken)
    for folder in (made, empty):
        make_empty(usable_folder(folder))
        (folder / "result.json").touch()
        make_empty(usable_folder(folder))
        assert sorted(path.name for path in folder.iterdir()) == [".dm_demo", "maps"]
    assert (mine / "thesis.tex").read_text() == "years"
