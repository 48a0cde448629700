"""Which tests start processes, in what order and portions the workers get them, and what skipped tests need.

Fixtures that every test may use are in src/dm_common/test/ros_fixtures.py, those of the tests across packages in
tests/conftest.py.
"""

from __future__ import annotations

import gc
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

pytest_plugins = ("ros_fixtures",)

# What is imported and collected stays to the end. Looked through for garbage again and again, as it grew and at the end
# of each worker, it took two fifths of the processor time of collecting.
gc.disable()

# A busy machine makes examples slow, and no test is timed.
settings.register_profile("suite", deadline=None)
settings.load_profile("suite")

#: Fixtures that start nodes or take a ROS domain.
PROCESS_FIXTURES = {"domain", "observer", "start"}
#: Modules in the order in which the workers take them: those that take longest first, so that all workers end together
#: (`./dm test --durations=0` measures). Tests of nodes mostly wait and others compute, so both take turns: else cores
#: idle first and are short later. The others follow as they were collected.
LONGEST = (
    "test_documentation",
    "test_console_operations",
    "test_whole_runs",
    "test_answers",
    "test_end_to_end",
    "test_one_owner",
    "test_hysteresis_identify",
    "test_faults_processes",
    "test_console_page",
    "test_apt_generation",
    "test_faults_network",
    "test_paper",
    "test_doctor",
    "test_faults_calibration",
    "test_ablation",
    "test_console_other_mirrors",
    "test_calibration_report",
    "test_faults_controller",
    "test_compare_mirrors",
    "test_faults_soak",
    "test_compare",
    "test_faults_driver",
    "test_hysteresis_fit",
    "test_calibration_resume",
    "test_recording",
    "test_membrane_mirror",
    "test_calibration_faults",
    "test_benchmark_ratios",
    "test_focus_hysteresis",
    "test_recalibration_node",
    "test_recipe_building",
    "test_report_writer",
    "test_calibration_node",
    "test_hysteresis_forecast",
    "test_recalibration_on_simulation",
    "test_autofocus_node",
    "test_registration_on_simulation",
    "test_own_laws",
    "test_calibrate",
    "test_focus_controller_node",
    "test_regression_services",
    "test_second_mirror",
    "test_many_mirrors",
    "test_report_command",
    "test_driver_node",
    "test_compare_autofocus",
    "test_interferometer_node",
    "test_hysteresis_control",
    "test_actuator_writer",
    "test_electronics_contract",
)
#: Modules whose tests share nothing that takes long to make: a worker takes one test of them at a time. Of all others
#: it takes the whole module.
TEST_BY_TEST = frozenset(
    {
        "test_actuator_writer",
        "test_autofocus_node",
        "test_calibration_faults",
        "test_calibration_node",
        "test_driver_node",
        "test_electronics_contract",
        "test_faults_calibration",
        "test_faults_controller",
        "test_faults_driver",
        "test_faults_fuzz",
        "test_faults_network",
        "test_faults_processes",
        "test_faults_soak",
        "test_focus_controller_node",
        "test_interferometer_node",
        "test_loop_actions",
        "test_many_mirrors",
        "test_recalibration_node",
        "test_virtual_bench_node",
        "test_whole_runs",
    }
)
_COMMAND = re.compile(r"\brun it with: (.+)$")
_MARK = re.compile(r"(?m)^pytestmark = \[?pytest\.mark\.(\w+)")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules of which `-m` leaves nothing are not imported either."""
    marked = _MARK.search(collection_path.read_text()) if collection_path.suffix == ".py" else None
    return True if marked and f"not {marked[1]}" in config.getvalue("markexpr").split(" and ") else None


@pytest.hookimpl(tryfirst=True)  # before `-m` leaves out what it does not want
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts processes and sort by duration."""
    for item in items:
        if PROCESS_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.processes)
    rank = {name: position for position, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_collection_finish() -> None:
    """Look for garbage from now on, among what the tests make."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """What `--dist loadfile` does here: modules whole, but for those of TEST_BY_TEST."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling  # not where packages are tested by colcon

    class Portions(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = str(super()._split_scope(nodeid))
            return nodeid if Path(module).stem in TEST_BY_TEST else module

    return Portions(config, log)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """One line on what was skipped: how many tests, and the commands that bring them back."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = [report.longrepr[2] for report in reports if isinstance(report.longrepr, tuple)]
    commands = {found[1]: None for reason in reasons if (found := _COMMAND.search(reason))}
    if reports:
        cure = f"; to run them: {' && '.join(commands)}" if commands else "; the reasons stand above"
        terminalreporter.write_line(f"tests skipped: {len(reports)}{cure}")
