"""The poke check on the simulated instrument and mirror, mounted in any way: found, put right, then as configured."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.calibrator import calibrate, check_fit
from dm_calibration.influence.poke_check import PokeCheck, check_pokes
from dm_calibration.influence.poke_cure import parameter_text, poke_cure
from dm_calibration.map_files import SurfaceMap
from dm_calibration.optics.aperture import InsufficientDataError
from dm_calibration.optics.orientation import Orientation
from dm_calibration.procedure.map_comparison import check_comparable
from dm_calibration.procedure.outcome import Outcome
from dm_common.errors import MeasurementError
from dm_common.geometry import hexagonal_positions
from dm_common.measurement import Measurement
from dm_common.mirror import Mirror
from dm_common.optics.sampling import edge_clustered_points
from dm_simulation.interferometer.interferometer import Interferometer, InterferometerConfig
from dm_simulation.mirror.plate import Plate, PlateConfig

RADIUS = 11e-3
MIRROR = Mirror("PDM30-37", "T-1", *hexagonal_positions(), RADIUS)
CAMERA = InterferometerConfig(pixels=260, field_diameter=26e-3, specks=20, blobs=2)


class MountedMirror:
    """The simulated plate in front of the simulated instrument; `channel` (N,) of each actuator, truly."""

    def __init__(
        self, plate: PlateConfig, camera: InterferometerConfig, channel: np.ndarray, tells_pitch: bool = True
    ) -> None:
        """Maps that do not tell their pitch show the mirror's aperture and nothing beside it."""
        self.tells_pitch = tells_pitch
        self.camera = Interferometer(camera, Plate(plate), np.random.default_rng(1), np.random.default_rng(2))
        self.channel = channel
        self.ingest = Ingest(300)

    def check(self, settings: IngestSettings, channels: np.ndarray) -> tuple[PokeCheck, Measurement]:
        """Poke all actuators by their configured `channels` (N,)."""
        signals = np.vstack((np.zeros(37), np.kron(np.eye(37), [[0.5], [-0.5]])))
        maps = []
        for row in signals:
            at_channel = dict(zip(channels, row, strict=True))
            maps.append(
                self._map(np.array([4e-6 * at_channel.get(channel, 0.0) for channel in self.channel]), settings)
            )
        return check_fit(calibrate(maps, signals, mirror=MIRROR).fit, MIRROR), maps[-1]

    def _map(self, bases: np.ndarray, settings: IngestSettings) -> Measurement:
        sag, pitch = self.camera.measure(bases), self.camera.pitch
        if not self.tells_pitch:
            away = (np.arange(len(sag)) - 0.5 * (len(sag) - 1)) * pitch
            sag = np.where(np.hypot(away, away[:, None]) <= RADIUS, sag, np.nan)
        surface = SurfaceMap(sag, CAMERA.wavelength, pitch if self.tells_pitch else None, "simulation")
        return self.ingest.measure(surface, settings)[1]


def settings_from(values: dict[str, object]) -> IngestSettings:
    orientation = Orientation(*(values[f"orientation.{name}"] for name in ("flip_x", "flip_y", "rotate_deg")))  # type: ignore[arg-type]
    return IngestSettings(
        orientation=orientation,
        aperture_radius=float(values["aperture.radius"]),  # type: ignore[arg-type]
        aperture_centre=(values["aperture.centre_x"], values["aperture.centre_y"]),  # type: ignore[arg-type]
        aperture_follow=bool(values["aperture.follow"]),
        pitch=float(values.get("pitch", 0.0)),  # type: ignore[arg-type]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start_deg", "camera", "before"),
    [
        (60.0, {"mount_angle": np.radians(35.0), "mount_mirrored": True}, Orientation()),
        (0.0, {"mount_angle": -2.5, "mount_x": 1.5e-3, "mount_y": -0.8e-3, "flip_x": True}, Orientation(flip_y=True)),
        (-120.0, {"mount_x": -1e-3, "rotate_deg": 90, "mount_scale": 1.02}, Orientation(True, False, 20.0)),
        (17.0, {"mount_mirrored": True, "mount_y": 1.5e-3, "mount_scale": 0.98}, Orientation(True, True, -100.0)),
    ],
)
@pytest.mark.parametrize("crossed", [False, True])
def test_what_is_found_puts_it_right(
    start_deg: float, camera: dict[str, object], before: Orientation, crossed: bool
) -> None:
    wiring = np.random.default_rng(5).permutation(40)[:37]
    true = wiring.copy()
    if crossed:
        true[[4, 20]], true[[9, 10]] = true[[20, 4]], true[[10, 9]]
    plate = PlateConfig(start_angle=float(np.radians(start_deg)))
    mounted = MountedMirror(plate, replace(CAMERA, **camera), true)  # type: ignore[arg-type]
    settings = IngestSettings(orientation=before, aperture_radius=RADIUS, aperture_centre=(0.0, 2e-4))
    first, last = mounted.check(settings, wiring)
    assert not first.passed and first.turned
    assert sum("exchanged" in finding for finding in first.findings) == (2 if crossed else 0), first.findings
    assert len(first.findings) == (3 if crossed else 1)
    changes, beyond = poke_cure(first, MIRROR, last, list(wiring))
    assert not beyond
    text = parameter_text(changes)
    cure = {key.rsplit("/", 1)[-1]: part["ros__parameters"] for key, part in yaml.safe_load(text).items()}
    assert ("pdm_driver" in cure) == crossed
    channels = np.array(cure["pdm_driver"]["mirror.channels"]) if crossed else wiring
    second, _ = mounted.check(settings_from(cure["interferometer"]), channels)
    assert second.passed, second.findings
    assert second.registration is not None
    assert abs(second.registration.turn) < np.radians(0.2) and np.hypot(*second.registration.shift) < 1e-4
    assert second.registration.scale == pytest.approx(float(camera.get("mount_scale", 1.0)), abs=0.01)  # type: ignore[arg-type]


@pytest.mark.parametrize("thickness", [1.5e-3, 2.4e-3])
def test_a_plate_is_not_taken_for_a_membrane(thickness: float) -> None:
    """Its bumps lean nowhere: the sign of all maps was not told, nor that the pitch is as configured."""
    plate = Plate(PlateConfig(actuators=19, pitch=6.2e-3, thickness=thickness))
    points, radius, noise = edge_clustered_points(300), 15e-3, np.random.default_rng(0)
    sag = 1e-6 * plate.influence_at(radius * points.x, radius * points.y)
    sag = sag * (1.0 + 0.1 * noise.standard_normal(19)) + 3e-9 * noise.standard_normal(sag.shape)
    none = np.zeros(19, dtype=np.bool_)
    found = [check_pokes(way * sag, points, plate.x, plate.y, radius, silent=none, unmoved=none) for way in (1, -1)]
    (inverted,) = [each for each in found[1].findings if "opposite" in each]
    assert "all actuators move the surface the opposite way" in inverted
    assert not any("apart, configured" in each for check in found for each in check.findings)


@pytest.mark.slow
def test_maps_that_do_not_tell_their_lateral_resolution_are_not_refused_with_the_cure() -> None:
    wiring = np.arange(37)
    mounted = MountedMirror(PlateConfig(), replace(CAMERA, mount_angle=0.5), wiring, tells_pitch=False)
    found, last = mounted.check(IngestSettings(), wiring)
    assert found.turned and last.pitch == 0.0
    lost, beyond = poke_cure(found, MIRROR, replace(last, camera=(0, 0)), [])
    assert "aperture.centre_x" not in lost["interferometer"] and "is not known, so it stays as it is" in beyond
    changes, beyond = poke_cure(found, MIRROR, last, [])
    assert not beyond
    cure = yaml.safe_load(parameter_text(changes))["/**/interferometer"]["ros__parameters"]
    assert cure["pitch"] == pytest.approx(mounted.camera.pitch, rel=0.02)
    again, _ = mounted.check(settings_from(cure), wiring)
    assert again.passed, again.findings


@pytest.mark.slow
def test_an_aperture_that_follows_the_mirror_does_so_with_the_cure() -> None:
    """Also when the mirror is put back beside its old place."""
    wiring = np.arange(37)
    settings = IngestSettings(aperture_radius=RADIUS, aperture_centre=(0.0, 2e-4), aperture_follow=True)
    camera = replace(CAMERA, mask_diameter=0.024, mount_angle=0.6, mount_mirrored=True, mount_x=5e-4)
    found, last = MountedMirror(PlateConfig(), camera, wiring).check(settings, wiring)
    cure = yaml.safe_load(parameter_text(poke_cure(found, MIRROR, last, [])[0]))["/**/interferometer"][
        "ros__parameters"
    ]
    moved = replace(camera, mount_x=-7e-4, mount_y=4e-4)
    again, _ = MountedMirror(PlateConfig(), moved, wiring).check(settings_from(cure), wiring)
    assert again.passed and again.registration is not None
    assert np.hypot(*again.registration.shift) < 1e-4


@pytest.mark.slow
def test_a_mirror_as_configured_passes() -> None:
    wiring = np.arange(37)
    found, _ = MountedMirror(PlateConfig(), CAMERA, wiring).check(IngestSettings(aperture_radius=RADIUS), wiring)
    assert found.passed and "not mirrored" in found.pose


@pytest.mark.slow
def test_an_aperture_that_the_camera_does_not_hold() -> None:
    """No parameter helps: the mirror has to be moved."""
    wiring = np.arange(37)
    camera = replace(CAMERA, pixels=220, field_diameter=22e-3, mount_x=1.5e-3, mount_angle=1.0)
    found, last = MountedMirror(PlateConfig(), camera, wiring).check(IngestSettings(aperture_radius=RADIUS), wiring)
    changes, beyond = poke_cure(found, MIRROR, last, [])
    assert re.search(r"move the mirror or the camera by -1\.[45]\d mm in x", beyond), beyond
    assert changes["interferometer"].keys() == {f"orientation.{name}" for name in ("flip_x", "flip_y", "rotate_deg")}


def test_a_third_of_the_pupil_is_no_map() -> None:
    """Refused before any check: fewer pixels than the aperture needs, or another aperture than the mirror's."""
    sag = np.zeros((260, 260))
    sag[:, 90:] = np.nan
    surface = SurfaceMap(sag, CAMERA.wavelength, 1e-4, "a third")
    with pytest.raises(InsufficientDataError, match=r"27\.4 % of the aperture"):
        Ingest(300).measure(surface, IngestSettings(aperture_radius=RADIUS))
    _, found = Ingest(300).measure(surface, IngestSettings())
    with pytest.raises(MeasurementError, match="aperture radius 4"):
        check_comparable(found, Outcome(), RADIUS)
    # Without a lateral resolution, another aperture than the maps before.
    whole, part = np.zeros((260, 260)), replace(surface, pitch=None)
    before = Outcome(records=[Ingest(300).measure(replace(surface, sag=whole, pitch=None), IngestSettings())[1]])
    with pytest.raises(MeasurementError, match=r"aperture radius 44\.5 pixels, in the maps before 129\.5"):
        check_comparable(Ingest(300).measure(part, IngestSettings())[1], before, RADIUS)
