"""A long run, shortened: structure and flatness."""

from __future__ import annotations

from pathlib import Path

import pytest

from fault_injection.soak import RATE, WINDOWS, soak
from fault_injection.soak_result import NODES, SoakResult, Window

pytestmark = pytest.mark.processes

SECONDS = 25.0


def test_nothing_grows_under_a_stream_of_requests(tmp_path: Path, domain: int) -> None:
    result = soak(SECONDS, tmp_path, domain)
    figures = result.figures()
    assert result.complaints() == []
    assert len(result.windows) == WINDOWS
    assert figures["minutes"] * 60.0 == pytest.approx(SECONDS, rel=0.5)
    assert figures["rate"] == pytest.approx(RATE, rel=0.2)
    assert 0 < figures["answered"] <= figures["requests"]
    assert figures["p99_ratio_end_to_start"] > 0.0
    assert set(figures["handles"]) == set(figures["threads"]) == set(figures["rss_mb"]) == set(NODES)
    assert all(count > 0 for count in figures["handles"].values())


def result(growing: str = "", by: float = 0.0, **fields: int) -> SoakResult:
    """A run over which one figure of the driver grows steadily."""
    windows = []
    for number in range(WINDOWS):
        grown = {name: by * number if name == growing else 0.0 for name in ("rss_mb", "handles", "threads")}
        window = Window(latency_us=[100.0 + number] * 100, relay_us=[50.0] * 10)
        for name, more in grown.items():
            getattr(window, name).update({node: 100.0 + (more if node == "pdm_driver" else 0.0) for node in NODES})
        windows.append(window)
    counts = {"requests": 1000, "answered": 1000, "refused": 0, "limit_violations": 0} | fields
    return SoakResult(seconds=60.0, windows=tuple(windows), **counts)


@pytest.mark.parametrize(
    ("growing", "by"), [("rss_mb", 1.0), ("handles", 0.5), ("threads", 0.5)]
)  # per window, of which there are 20
def test_growth_is_told_of(growing: str, by: float) -> None:
    assert [words.split(" grew")[0] for words in result(growing, by).complaints()] == [f"{growing} of pdm_driver"]


def test_harm_and_refusals_are_told_of() -> None:
    assert result().complaints() == []
    assert result(limit_violations=2, refused=3).complaints() == ["2 frames beyond a limit", "3 requests refused"]


def test_start_and_end_are_those_of_a_fifth_of_the_run() -> None:
    figures = result("rss_mb", 1.0).figures()
    assert figures["rss_growth_mb"] == pytest.approx(16.0)  # medians of windows 0 to 3 and 16 to 19
    assert figures["p99_ratio_end_to_start"] == pytest.approx((100.0 + 17.5) / (100.0 + 1.5))
    assert figures["relay_p99_ratio_end_to_start"] == 1.0
