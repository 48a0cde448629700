"""A run's figures as the tables of docs/benchmarks.md."""

from __future__ import annotations

from typing import Any


def target_table(figures: dict[str, Any]) -> str:
    """Markdown table of the targets of a run."""
    lines = ["| job | measured | to reach | beside it, in the same run |", "|---|---|---|---|"]
    for row in figures["targets"]:
        beside = ", ".join(f"{name} {_number(value)}" for name, value in row["beside"].items() if value is not None)
        unit, verdict = row["unit"], "" if row["met"] else ", **not met**"
        measured, limit = f"{_number(row['value'])} {unit}".strip(), f"≤ {_number(row['limit'])} {unit}".strip()
        lines.append(f"| {row['job']} | {measured} | {limit}{verdict} | {beside} |")
    return "\n".join(lines)


def growth_table(figures: dict[str, Any]) -> str:
    """Markdown table of the exponents of growth of a run."""
    lines = ["| figure | exponent |", "|---|---|"]
    for name, value in figures["slopes"].items():
        size, _, figure = name.partition("_")
        lines.append(
            f"| {figure.removesuffix('_ms').removesuffix('_mb').replace('_', ' ')}, over {size} | {value:.2f} |"
        )
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
