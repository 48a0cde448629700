"""What `dm calibrate --boresight` does with what the camera shows, without nodes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest
import typer

import dm_autofocus
import dm_tools.boresight
from dm_autofocus.boresight import Boresight, image_shift
from dm_bringup.suite import load_config
from dm_client import DeformableMirrorError

RADIUS = 0.011
SCALE = 1e7 * np.array([[0.0, -1.0], [1.0, 0.0]])  # the camera is rolled by a quarter turn
AXIS = np.array([0.4e-3, -0.1e-3])


class PlayedCamera:
    """Its axis meets the mirror at AXIS; `still` tells the truth, or what a scene of many distances makes of it."""

    still = True
    mirror_info = SimpleNamespace(serial="virtual-1")
    capabilities = SimpleNamespace(aperture_radius=RADIUS)

    def __init__(self, _namespace: str, held: dict[str, Any]) -> None:
        self._held = held

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        pass

    def focus_range(self) -> Any:
        return SimpleNamespace(curvature_min=-0.05, curvature_max=0.05)

    def wait(self, _condition: Any, _timeout_s: float) -> bool:
        return True

    def boresight(self, _region: Any, image_topic: str, stamp_lead: float, take_over: bool) -> Boresight:
        assert (image_topic, stamp_lead, take_over) == ("image_raw", 0.03, False)
        off = AXIS - self._held["optical_axis"] * (1 if self.still else -2)
        return Boresight(SCALE, SCALE @ off * RADIUS, np.full(2, 0.1))


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    values: dict[str, Any] = {"optical_axis": np.zeros(2), "stamp_lead": 0.03}
    monkeypatch.setattr(dm_autofocus, "CameraFocusClient", lambda namespace: PlayedCamera(namespace, values))
    monkeypatch.setattr(dm_tools.boresight, "get_parameter", lambda _client, _node, name: values[name])

    def take(_client: Any, _node: str, name: str, value: list[float]) -> None:
        values[name] = np.array(value)

    monkeypatch.setattr(dm_tools.boresight, "set_parameter", take)
    cost = {"curvature_min": -0.1, "curvature_max": 0.1, "residual_rms_nm": 8.0}
    monkeypatch.setattr(dm_tools.boresight, "price", lambda *_of: {"held": cost, "free": cost})
    return values


def test_the_axis_is_held_and_written(held: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "mine.yaml"
    dm_tools.boresight.run_boresight("", "0,0,1,1", "image_raw", False, target, None, None)
    np.testing.assert_allclose(held["optical_axis"], AXIS)
    np.testing.assert_allclose(load_config(target)["focus_controller"]["optical_axis"], AXIS)
    assert "tilt free: -0.1000 to +0.1000 1/m, at most 8.0 nm rms" in capsys.readouterr().out


def test_an_axis_that_makes_it_worse_is_not_kept(held: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlayedCamera, "still", False)
    with pytest.raises(DeformableMirrorError, match="at one distance"):
        dm_tools.boresight.run_boresight("", "0,0,1,1", "image_raw", False, None, None, None)
    np.testing.assert_allclose(held["optical_axis"], 0)


def test_an_axis_that_was_not_seen_to_be_right_is_not_kept(
    held: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    see = PlayedCamera.boresight

    def interrupted(camera: PlayedCamera, region: Any, **how: Any) -> Boresight:
        if np.any(held["optical_axis"]):
            raise KeyboardInterrupt
        return see(camera, region, **how)

    monkeypatch.setattr(PlayedCamera, "boresight", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dm_tools.boresight.run_boresight("", "0,0,1,1", "image_raw", False, None, None, None)
    np.testing.assert_allclose(held["optical_axis"], 0)


def test_a_region_outside_the_image_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="region inside it"):
        dm_tools.boresight.region_of("0.5,0,0.6,1")


def test_the_shift_of_a_picture() -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.meshgrid(np.fft.fftfreq(96), np.fft.rfftfreq(128), indexing="ij")
    spectrum = np.fft.rfft2(rng.standard_normal((96, 128))) / (0.02 + np.hypot(rows, columns))
    for right, down in ((0.3, -0.2), (-5.4, 3.7)):
        moved = spectrum * np.exp(-2j * np.pi * (columns * right + rows * down))
        before, after = (500 + 10 * np.fft.irfft2(part, (96, 128)) for part in (spectrum, moved))
        np.testing.assert_allclose(image_shift(before, after), (right, down), atol=0.15 + 0.05 * abs(right))
        after[5, 7] = np.nan
        np.testing.assert_allclose(image_shift(before, after), (right, down), atol=0.15 + 0.05 * abs(right))
    with pytest.raises(ValueError, match="the image is black"):
        image_shift(before, np.zeros_like(before))
