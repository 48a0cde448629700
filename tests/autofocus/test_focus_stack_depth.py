"""Distances from a stack through the simulated camera are those of its objects; what goes with them is complete."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest

from dm_autofocus.focus_stack import ImageStack
from dm_autofocus.focus_stack_action import camera_info_for
from dm_autofocus.optics import FocusOptics
from dm_simulation.camera import CameraConfig, SceneCamera, camera_matrix
from studies.autofocus.stacks import depths


@pytest.mark.slow
@pytest.mark.parametrize("photons", [5000.0, 300.0])
def test_distances_are_within_half_a_depth_of_focus(photons: float) -> None:
    for depth in depths(photons, step=4.0, distances=(5.5, 15.0, 30.0)):
        assert depth.share > 0.95
        assert depth.errors[0] < 0.25 and depth.errors[1] < 0.5
        assert depth.relative < 0.03


def test_the_depth_image_comes_with_a_projection() -> None:
    """As depth_image_proc needs it; a camera that is not calibrated is all zeros in ROS."""
    image = Image(height=240, width=320)
    image.header.frame_id = "camera"
    known = CameraInfo(k=[500.0, 0.0, 160.0, 0.0, 510.0, 120.0, 0.0, 0.0, 1.0])
    info = camera_info_for(image, known, 400.0)
    assert list(info.p) == [500.0, 0.0, 160.0, 0.0, 0.0, 510.0, 120.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert (info.header.frame_id, known.header.frame_id) == ("camera", "")
    uncalibrated = CameraInfo(width=640, height=480, binning_x=2, binning_y=2)
    for silent in (None, uncalibrated):
        info = camera_info_for(image, silent, 400.0)
        assert (info.width, info.height, info.k[0], info.p[0], info.p[2]) == (320, 240, 400.0, 400.0, 159.5)
        assert info.binning_x == 0
        assert not any(camera_info_for(image, silent, 0.0).p)


def points_of(depth: NDArray[np.float32], info: CameraInfo) -> NDArray[np.float64]:
    """Points (H, W, 3) [m] of a depth image as `convertDepth` of depth_image_proc makes them.

    Its camera model (image_geometry) takes P, moves its centre by the region of interest and divides by the binning.
    """
    binning = np.array([max(info.binning_x, 1), max(info.binning_y, 1)])
    projection = np.reshape(info.p, (3, 4))
    focal_length = np.diag(projection)[:2] / binning
    centre = (projection[:2, 2] - (info.roi.x_offset, info.roi.y_offset)) / binning
    rows, columns = np.indices(depth.shape)
    seen = np.where(np.isfinite(depth), depth.astype(float), np.nan)
    return np.stack(
        [(columns - centre[0]) * seen / focal_length[0], (rows - centre[1]) * seen / focal_length[1], seen], axis=-1
    )


@pytest.mark.slow
def test_a_cloud_of_points_is_where_the_objects_are() -> None:
    """Three flat objects side by side: their corners in space, by the projection that goes with the depth image."""
    distances = (6.0, 15.0, 40.0)
    config = CameraConfig(width=360, height=120, rest_distance=10.0, distances=distances)
    camera = SceneCamera(config, 0.022, np.random.default_rng(1), np.random.default_rng(2))
    optics, stack = FocusOptics.from_rest_distance(10.0), ImageStack(4)
    bowl = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]) * 0.011**2 / 2
    for curvature in np.linspace(-0.05, 0.05, 23):
        image = camera.expose(curvature * bowl)
        stack.add(float(curvature), image, image)
    depth = stack.enlarge(optics.distances_for(stack.in_focus(0.05))).astype(np.float32)
    known = CameraInfo(k=camera_matrix(config), width=360, height=120)
    points = points_of(depth, camera_info_for(Image(height=120, width=360), known, 0.0))
    pixel = config.pixel_pitch / config.focal_length
    for number, distance in enumerate(distances):
        part = points[20:100, number * 120 + 30 : number * 120 + 90]
        seen = part[np.isfinite(part).all(-1)]
        assert len(seen) > 0.9 * part.shape[0] * part.shape[1]
        assert np.median(seen[:, 2]) == pytest.approx(distance, rel=0.03)
        # Ends of the part across and along, by the pinhole camera and the true distance.
        across = (np.array([number * 120 + 30, number * 120 + 89]) - 179.5) * pixel * distance
        along = (np.array([20, 99]) - 59.5) * pixel * distance
        for axis, truth in ((0, across), (1, along)):
            ends = np.quantile(seen[:, axis] / seen[:, 2] * distance, (0, 1))
            np.testing.assert_allclose(ends, truth, atol=0.05 * np.ptp(truth))


def test_a_part_that_the_camera_reads_out_has_its_own_centre() -> None:
    """K and P are of the whole sensor: whoever projects takes region and binning into account, and finds both here."""
    known = CameraInfo(k=[500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0], binning_x=2, binning_y=2)
    known.roi = RegionOfInterest(x_offset=100, y_offset=40, width=200, height=100)
    info = camera_info_for(Image(height=50, width=100), known, 0.0)
    point = points_of(np.full((50, 100), 2.0, np.float32), info)[30, 60]
    np.testing.assert_allclose(point, [(60 - 109.75) * 2 / 250, (30 - 99.75) * 2 / 250, 2.0], rtol=1e-6)
    nothing = points_of(np.array([[np.nan, np.inf, -np.inf]], np.float32), info)
    assert np.isnan(nothing).all(), "as depth_image_proc: what is not finite is no point"
