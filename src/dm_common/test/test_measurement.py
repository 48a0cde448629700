"""One map counts once, whatever it is called the second time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dm_common.measurement import Measurement
from dm_common.optics.sampling import SamplePoints


def measured(stamp_ns: int, seed: int) -> Measurement:
    coefficients = np.random.default_rng(seed).standard_normal(21)
    return Measurement(
        points=SamplePoints(np.zeros(1), np.zeros(1), np.ones(1)),
        sag=np.zeros(1),
        coefficients=coefficients,
        sigma=np.zeros(21),
        stamp_ns=stamp_ns,
        residual_rms=0.0,
        valid_fraction=1.0,
    )


def test_a_file_that_was_measured_and_is_then_ingested_is_the_same_map() -> None:
    first = measured(1_000, 1)
    assert replace(first, stamp_ns=2_000).same_map(first)  # the time in the file's header
    assert measured(1_000, 2).same_map(first)
    assert not measured(2_000, 2).same_map(first)
