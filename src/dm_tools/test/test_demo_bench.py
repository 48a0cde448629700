"""Options, ports and folder of a virtual bench."""

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dm_tools.demo import demo, figures
from dm_tools.demo.demo_bench import bench_config, free_ports, make_empty, usable_folder
from dm_tools.doctor.bench import parameters


@pytest.mark.parametrize("option", ["creep", "seed", "speed"])
def test_the_demo_takes_what_its_nodes_take(option: str, tmp_path: Path) -> None:
    """Else one of them would end, and the demo after it."""
    (described,) = inspect.signature(demo.demo).parameters[option].annotation.__metadata__
    for value, right in ((described.min, True), (described.max, True), (2 * described.max, False)):
        given: dict[str, Any] = {"creep": 0.01, "seed": 1, "speed": 20.0, option: value}
        assert (parameters(bench_config(tmp_path, "drawn_preisach", **given)) is None) == right, value


def test_ports_that_nobody_has_bound_yet_are_not_handed_out_again() -> None:
    drawn = [port for _ in range(50) for port in free_ports(4)]
    assert len(set(drawn)) == len(drawn)


def test_a_demo_empties_its_own_folder_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine, made, empty = (tmp_path / name for name in ("mine", "made", "empty"))
    for folder in (mine, empty):
        folder.mkdir()
    (mine / "thesis.tex").write_text("years")
    (tmp_path / "file").touch()
    for taken in (mine, tmp_path, tmp_path / "file"):
        with pytest.raises(ValueError, match="exists and is not of a demo"):
            usable_folder(taken)
    for folder in (made, empty):
        make_empty(usable_folder(folder))
        (folder / "result.json").touch()
        monkeypatch.chdir(folder)
        make_empty(usable_folder(Path()))
        assert sorted(path.name for path in Path.cwd().iterdir()) == [".dm_demo", "maps"]
    assert (mine / "thesis.tex").read_text() == "years"


@pytest.mark.slow
def test_the_columns_of_the_picture_go_over_the_range_of_any_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[str] = []
    draw = figures.draw_command

    def spy(axes: Any, *others: Any) -> Any:
        titles.append(axes.get_title())
        return draw(axes, *others)

    monkeypatch.setattr(figures, "draw_command", spy)
    sag = np.add.outer(np.arange(8.0) ** 2, np.arange(8.0)) * 1e-9
    info = SimpleNamespace(pitch=1e-3, centre_x=3.5, centre_y=3.5, width=8, height=8, aperture_radius=4e-3)
    prediction = SimpleNamespace(signals=np.zeros(2), predicted_rms=1e-9)
    error = SimpleNamespace(residual=sag, rms=1e-9, max_zernike=1e-9)
    row = {"prediction": prediction, "sag": sag, "info": info, "error": error}
    rows = [row | {"curvature": round(0.005 + 0.0025 * step, 4)} for step in range(11)]  # a membrane is always hollow
    mirror = SimpleNamespace(actuator_x=[0.0, 1e-3], actuator_y=[0.0, 0.0])
    assert figures.save_sweep_figure(rows, tmp_path / "demo.png", "membrane", mirror).is_file()
    assert titles == [f"{curvature} 1/m" for curvature in ("+0.005", "+0.0125", "+0.0175", "+0.0225", "+0.03")]
