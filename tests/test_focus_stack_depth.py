"""Distances from a stack through the simulated camera are those of its objects; what goes with them is complete."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import CameraInfo, Image

from dm_autofocus.focus_stack_action import camera_info_for
from studies.autofocus.stacks import depths


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
    told = camera_info_for(image, None, 400.0)
    assert (told.width, told.height, told.k[0], told.p[0], told.p[2]) == (320, 240, 400.0, 400.0, 159.5)
    assert not any(camera_info_for(image, None, 0.0).p)
