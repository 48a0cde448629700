"""What `./dm measure` prints: with --reference-sphere, to be pasted, and what to do next."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import yaml
from dm_msgs.msg import Calibration, SurfaceMapInfo, ZernikeCoefficients
from dm_msgs.srv import Measure
from typer.testing import CliRunner

from dm_common.optics.conic import conic_coefficients
from dm_common.optics.zernike import DEFOCUS, SPOKEN
from dm_tools import cli
from dm_tools.verbs import measure


@pytest.mark.parametrize("instrument_error", [0.0, 5e-9])
def test_the_bound_of_the_scale_is_that_of_the_instrument(
    instrument_error: float, capsys: pytest.CaptureFixture[str]
) -> None:
    pitch, pixels = 200e-6, 55.0
    coefficients = conic_coefficients(1.0 / 1.5, 0.0, pixels * pitch)
    info = SimpleNamespace(aperture_radius_px=pixels, pitch=1.002 * pitch, instrument_error=instrument_error)
    assert measure._scale(info, list(coefficients), 1.5) == pytest.approx(pitch, rel=1e-6)
    text = capsys.readouterr().out
    values = yaml.safe_load(text[text.index("/**/") :])["/**/interferometer"]["ros__parameters"]
    assert values["pitch"] == pytest.approx(pitch, rel=1e-6)
    expected = 0.5 * instrument_error / coefficients[DEFOCUS]  # the scale goes with the root of the defocus
    assert values.get("scale_error", 0.0) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("radius", ["0", "nan", "inf"])
def test_what_is_no_radius_is_refused_before_a_map_is_taken(radius: str) -> None:
    done = CliRunner().invoke(cli.make_app(), ["measure", "--reference-sphere", radius])
    assert done.exit_code == 2 and f"--reference-sphere {radius}: must be a radius in m" in done.output


@pytest.mark.parametrize("sphere", [True, False])
def test_the_map_of_a_sphere_is_published_to_nobody(sphere: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = list[bool]()

    def failing(label: str, answer_only: bool) -> None:
        calls.append(answer_only)
        raise RuntimeError("no map")

    client = SimpleNamespace(measure=failing)
    monkeypatch.setattr(measure, "running_suite", lambda namespace: nullcontext(client))
    words = ["--reference-sphere", "2"] if sphere else []
    assert CliRunner().invoke(cli.make_app(), ["measure", *words]).exit_code == 1
    assert calls == [sphere]


@pytest.mark.parametrize(
    ("in_use", "then"), [("c1", "./dm check compares"), ("", "./dm status"), (None, "./dm status")]
)
def test_the_next_step_is_one_that_will_not_be_refused(
    in_use: str | None, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = Measure.Response(info=SurfaceMapInfo(), zernike=ZernikeCoefficients(coefficients=[0.0] * len(SPOKEN)))
    client = SimpleNamespace(
        measure=lambda label, answer_only: taken,
        messages={} if in_use is None else {"calibration": Calibration(id=in_use)},
        wait=lambda condition, timeout_s: bool(condition()),
    )
    monkeypatch.setattr(measure, "running_suite", lambda namespace: nullcontext(client))
    assert f"next: {then}" in CliRunner().invoke(cli.make_app(), ["measure"]).output
