"""A camera before a mirror, and what `./dm instrument` finds of it."""

from __future__ import annotations

from typing import Any

from typer.testing import CliRunner

from dm_calibration.acquisition.ingest import IngestSettings
from dm_tools.cli import make_app

PIXELS, FIELD = 200, 0.022
SETTINGS = IngestSettings(aperture_radius=0.0095, pitch=FIELD / PIXELS)


def run(*arguments: object) -> dict[str, Any]:
    """The parameters that `./dm instrument` prints."""
    import yaml

    result = CliRunner().invoke(make_app(), ["instrument", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    text = result.stdout[result.stdout.index("/**/") :].partition("next:")[0]
    return dict(yaml.safe_load(text)["/**/interferometer"]["ros__parameters"])
