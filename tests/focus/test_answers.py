"""What every interface answers to right and wrong values is what docs/interfaces.md says."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest

from dm_tools.demo import demo_bench
from fault_injection.rigs.forked_node import ForkedSuite
from studies.documentation.answer_cases import CASES
from studies.documentation.answers import PAGE, committed, parsed, run, section
from studies.documentation.special_cases import BENCH, HELD


@pytest.mark.processes
def test_the_table_of_answers_is_what_a_run_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_bench, "Suite", ForkedSuite)
    wanted = committed(PAGE.read_text())
    assert wanted and wanted.strip() == section(run()).strip(), "./dm exec python -m studies.documentation.answers"


def fields(kind: Any, before: str = "") -> Iterator[str]:
    """The fields of a request or goal, with those of our messages within."""
    for name, held in kind.get_fields_and_field_types().items():
        package, _, nested = held.removeprefix("sequence<").rstrip(">").partition("/")
        yield before + name
        if package == "dm_msgs":
            yield from fields(getattr(import_module("dm_msgs.msg"), nested), f"{before}{name}.")


def given(values: Any, before: str = "") -> Iterator[str]:
    """The fields that a case gives."""
    for name, value in values.items():
        yield before + name
        for nested in value if isinstance(value, list) else [value]:
            if isinstance(nested, dict):
                yield from given(nested, f"{before}{name}.")


@pytest.mark.parametrize("name", [*CASES, *BENCH])
def test_every_field_of_a_request_is_tried(name: str) -> None:
    kind, cases = (CASES | BENCH)[name]
    tried = {field for case in (*cases, *HELD.get(name, ())) for field in given(parsed(case, {}))}
    asked = getattr(kind, "Goal", getattr(kind, "Request", kind))
    assert set(fields(asked)) <= tried
