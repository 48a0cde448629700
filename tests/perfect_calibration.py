"""What a perfect calibration would say of a mirror that a test knows."""

from __future__ import annotations

from dm_controller.planning.mirror_model import InfluenceModel
from linear_mirror import RADIUS, LinearMirror


def perfect_model(mirror: LinearMirror, held_out: float = 1e-10) -> InfluenceModel:
    """The influence functions of `mirror` without error, with a held-out error (m) of choice."""
    return InfluenceModel(
        aperture_radius=RADIUS,
        influence_zernike=mirror.fit_terms(mirror.influence.T).T,
        zernike_offset=mirror.figure_coefficients,
        points=mirror.points,
        influence_sag=mirror.influence,
        sag_offset=mirror.modes @ mirror.figure_coefficients,
        held_out_rms=held_out,
        held_out_max_zernike=held_out,
    )
