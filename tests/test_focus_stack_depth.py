"""Distances from a stack through the simulated camera are those of its objects."""

from __future__ import annotations

import pytest

from studies.autofocus.stacks import depths


@pytest.mark.parametrize("photons", [5000.0, 300.0])
def test_distances_are_within_half_a_depth_of_focus(photons: float) -> None:
    for depth in depths(photons, step=4.0, distances=(5.5, 15.0, 30.0)):
        assert depth.share > 0.95
        assert depth.errors[0] < 0.25 and depth.errors[1] < 0.5
        assert depth.relative < 0.03
