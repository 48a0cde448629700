"""The sampling study of section 2.2 on simulated surfaces: edge-clustered and uniform points against every pixel."""

from __future__ import annotations

import numpy as np

from dm_simulation.interferometer.interferometer import InterferometerConfig
from studies.paper.samples import Samples
from studies.paper.sampling_study import SamplingStudy, study_sampling

#: Every so many surfaces of Table 1 are studied: pokes, spheres and Zernike surfaces among them.
STRIDE = 6
#: Noise maps.
DRAWS = 10


def study_samples(samples: Samples) -> SamplingStudy:
    """Set surfaces of Table 1 on a copy of the simulation and sample the noise-free maps of them in all ways.

    The pixel noise is the instrument's; the noise draws follow from the simulation's seed.
    """
    bench = samples.bench.fork()
    surfaces = []
    for label in samples.labels[::STRIDE]:
        bench.apply(samples.calibration.maps.applied[samples.row(label)])
        bench.settle()
        surfaces.append(bench.true_map())
    return study_sampling(
        np.stack(surfaces),
        bench.aperture,
        InterferometerConfig().pixel_noise,
        np.random.default_rng(bench.config.seed),
        draws=DRAWS,
        count=bench.config.samples,
    )
