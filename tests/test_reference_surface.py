"""Maps of a simulated instrument with an error of its own, which a reference surface takes out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dm_calibration.acquisition.ingest import Ingest, IngestSettings
from dm_calibration.acquisition.reference_surface import load_reference
from dm_calibration.map_files import SurfaceMap
from dm_calibration.optics.orientation import Orientation
from dm_common.optics.zernike import PISTON_TILT
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig


@pytest.mark.parametrize("turned", [{}, {"rotate_deg": 90, "flip_x": True}])
def test_results_are_absolute_with_the_reference_that_the_bench_leaves(turned: dict[str, Any], tmp_path: Path) -> None:
    config = BenchConfig(
        seed=3,
        interferometer=InterferometerConfig(pixels=200, instrument_error=30e-9, **turned),
        ports=PortsConfig(OFF, OFF, OFF),
        files=FilesConfig(tmp_path, format="dat"),
        trigger_port=OFF,
    )
    bench = VirtualBench(config)
    try:
        file, truth = bench.measure(), bench.interferometer.true_sag(bench.displacement())
    finally:
        bench.close()
    settings = IngestSettings(orientation=Orientation(rotate_deg=90.0), aperture_radius=0.0108, pitch=11e-5)
    reference = load_reference(str(tmp_path / "reference" / "flat.datx"), "", 0.0, 0.0)
    ingest = Ingest()
    wanted = ingest.measure(SurfaceMap(truth, 632.8e-9, None, "array"), settings)[1]
    relative, absolute = (ingest.read(file, replace(settings, reference=each))[1] for each in (None, reference))
    errors = [np.abs(each.coefficients - wanted.coefficients)[PISTON_TILT:].max() for each in (relative, absolute)]
    assert errors[1] < 1e-9 < 8e-9 < errors[0]
