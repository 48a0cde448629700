"""The picture of what the virtual bench simulates."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies import simulation_plot


@pytest.mark.slow
def test_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "bench.png"
    options = ["--output", str(picture), "--poke", "37", "--law", "bouc_wen", "--curvature", "-0.02"]
    assert simulation_plot.main(options) == 0
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert simulation_plot.main(["--output", str(picture), "--poke", "38"]) == 1
    assert "--poke 38: must be 1 to 37" in capsys.readouterr().err
