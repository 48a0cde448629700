"""docs/parameters.md from the tables that declare the parameters (`python -m dm_tools.documentation.parameters`)."""

from __future__ import annotations

from dm_autofocus.autofocus_parameters import PARAMETERS as AUTOFOCUS
from dm_calibration.calibration_parameters import PARAMETERS as CALIBRATION
from dm_calibration.interferometer_parameters import PARAMETERS as INTERFEROMETER
from dm_common.ros.parameters import as_markdown
from dm_controller.focus_parameters import PARAMETERS as FOCUS_CONTROLLER
from dm_driver.driver_parameters import PARAMETERS as DRIVER
from dm_simulation.parameters import TABLE as VIRTUAL_BENCH

TABLES = {
    "pdm_driver": DRIVER,
    "interferometer": INTERFEROMETER,
    "calibration": CALIBRATION,
    "focus_controller": FOCUS_CONTROLLER,
    "autofocus": AUTOFOCUS,
    "virtual_bench": VIRTUAL_BENCH,
}


def parameters_page() -> str:
    """The page, in Markdown."""
    parts = [
        "# Parameters",
        "",
        "Written from the code by `./dm exec python -m dm_tools.documentation.parameters`; a test keeps it true. Numbers of type",
        "double need a point in YAML (`300.0`, not `300`): ROS 2 does not convert integers.",
        "",
    ]
    for node, table in TABLES.items():
        parts += [f"## {node}", "", as_markdown(table)]
    return "\n".join(parts)


if __name__ == "__main__":
    print(parameters_page(), end="")
