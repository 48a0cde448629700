"""What a long run came to: latencies, and whether memory, handles or threads of a node grew."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

NODES = ("virtual_bench", "pdm_driver", "focus_controller")
#: What may be added from start to end before it counts as growth.
GROWTH_MB, GROWTH_COUNT = 8.0, 2


@dataclass
class Window:
    """What was seen in a part of the run.

    Attributes:
        latency_us: from a request to its command, one each.
        relay_us: the same of the bare relay.
        rss_mb, handles, threads: by node, at the end of the window.
    """

    latency_us: list[float] = field(default_factory=list)
    relay_us: list[float] = field(default_factory=list)
    rss_mb: dict[str, float] = field(default_factory=dict)
    handles: dict[str, int] = field(default_factory=dict)
    threads: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SoakResult:
    """How a long run went.

    Attributes:
        seconds: from the first request to the last, warm-up included.
        requests: sent.
        answered: requests of which `focus_state` told; the others were overtaken by a newer one.
        refused: of them.
        limit_violations: frames at the emulated electronics beyond a limit.
        windows: after the warm-up, in order.
    """

    seconds: float
    requests: int
    answered: int
    refused: int
    limit_violations: int
    windows: tuple[Window, ...]

    def growth(self, name: str) -> dict[str, float]:
        """By node: of `rss_mb`, `handles` or `threads`, from start to end."""
        rows = [getattr(window, name) for window in self.windows]
        return {node: _end(values) - _start(values) for node in NODES if (values := [row[node] for row in rows])}

    def p99_us(self, name: str = "latency_us") -> tuple[float, float]:
        """99th percentile of the latency at start and end; of the relay with the name `relay_us`."""
        samples = [getattr(window, name) for window in self.windows]
        levels = [float(np.percentile(each, 99)) for each in samples if each]
        return (_start(levels), _end(levels)) if levels else (float("nan"), float("nan"))

    def complaints(self) -> list[str]:
        """What was harmed, lost or has grown."""
        found = []
        if self.limit_violations:
            found.append(f"{self.limit_violations} frames beyond a limit")
        if self.refused:
            found.append(f"{self.refused} requests refused")
        for name, most in (("rss_mb", GROWTH_MB), ("handles", GROWTH_COUNT), ("threads", GROWTH_COUNT)):
            found += [
                f"{name} of {node} grew by {grown:.1f}" for node, grown in self.growth(name).items() if grown > most
            ]
        return found

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        start, end = self.p99_us()
        relay_start, relay_end = self.p99_us("relay_us")
        by_node = self.growth("rss_mb")
        return {
            "minutes": self.seconds / 60.0,
            "requests": self.requests,
            "answered": self.answered,
            "refused": self.refused,
            "rate": self.requests / self.seconds,
            "limit_violations": self.limit_violations,
            "rss_growth_mb": max(by_node.values()),
            "rss_growth_mb_by_node": by_node,
            "rss_mb": self.windows[-1].rss_mb,
            "handles_growth": max(self.growth("handles").values()),
            "threads_growth": max(self.growth("threads").values()),
            "handles": self.windows[-1].handles,
            "threads": self.windows[-1].threads,
            "p99_start_us": start,
            "p99_end_us": end,
            "p99_ratio_end_to_start": end / start,
            "relay_p99_ratio_end_to_start": relay_end / relay_start,
        }


def _start(values: list[float]) -> float:
    return float(np.median(values[: max(len(values) // 5, 1)]))


def _end(values: list[float]) -> float:
    return float(np.median(values[-max(len(values) // 5, 1) :]))
