"""Which tests start processes, in what order the workers get the modules, and what skipped tests need.

The fixtures of the tests across packages are in tests/conftest.py.
"""

from __future__ import annotations

import re

import pytest

#: Fixtures of tests/conftest.py that start nodes or take a ROS domain.
PROCESS_FIXTURES = {"domain", "observer", "start"}
#: Modules in the order in which the workers take them: those that take longest first, so that all workers end together
#: (`./dm test --durations=0` measures). The others follow as they were collected.
LONGEST = (
    "test_calibration_faults",
    "test_documentation",
    "test_faults_controller",
    "test_faults_processes",
    "test_calibration_watch",
    "test_faults_network",
    "test_end_to_end",
    "test_faults_calibration",
    "test_calibration_node",
    "test_faults_driver",
    "test_ablation",
    "test_hysteresis_forecast",
    "test_regression_services",
    "test_focus_hysteresis",
    "test_report_writer",
    "test_many_mirrors",
    "test_autofocus_node",
    "test_focus_controller_node",
    "test_interferometer_node",
    "test_faults_soak",
    "test_report_command",
    "test_second_mirror",
)
_COMMAND = re.compile(r"\brun it with: (.+)$")


@pytest.hookimpl(tryfirst=True)  # before `-m` leaves out what it does not want
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts processes and sort by duration."""
    for item in items:
        if PROCESS_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.processes)
    rank = {name: position for position, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One line on what was skipped: how many tests, and the commands that bring them back."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = [report.longrepr[2] for report in reports if isinstance(report.longrepr, tuple)]
    commands = {found[1]: None for reason in reasons if (found := _COMMAND.search(reason))}
    if reports:
        cure = f"; to run them: {' && '.join(commands)}" if commands else "; the reasons stand above"
        terminalreporter.write_line(f"tests skipped: {len(reports)}{cure}")
