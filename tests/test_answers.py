"""What every interface answers to right and wrong values is what docs/interfaces.md says."""

from __future__ import annotations

import pytest

from studies.documentation.answers import PAGE, committed, run, section

pytestmark = pytest.mark.processes


def test_the_table_of_answers_is_what_a_run_gives() -> None:
    wanted = committed(PAGE.read_text())
    assert wanted and wanted.strip() == section(run()).strip(), "./dm exec python -m studies.documentation.answers"
