"""The bounded solve for commands that saturate, beside a general solver and beside clipping."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from dm_common import Floats
from dm_common.bounded import BoundedProgramme
from dm_common.geometry import hexagonal_positions, ring_count
from dm_common.limits import Limits
from dm_common.optics.piston_tilt import remove_piston_tilt
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import TERMS, basis
from studies.benchmarks.timing import Effort, medians
from studies.solvers.plate_model import PlateProperties, plate_influence

PITCH = 4.3e-3  # m between actuators of a PDM30-37
STROKE = 4e-6  # m per unit signal
#: Ridge as a share of an actuator's typical response, as in the focus controller.
RIDGE_SHARE = 0.01
#: Smallest and largest defocus, m: from one actuator at its limit to most of them.
SATURATING = (2e-6, 4.5e-6)
SATURATED_TARGETS = 24


@dataclass(frozen=True)
class Problem:
    """A mirror's bounded programme, and the matrix and ridge that it is made of, for other solvers."""

    programme: BoundedProgramme
    matrix: Floats
    ridge: float
    terms: Floats  # (P, 21) at the points, weighted


def problem(actuators: int) -> Problem:
    """The programme of an analytic plate on a full hexagon of actuators, its aperture growing with the hexagon.

    Raises:
        ValueError: no full hexagon has that number of actuators.
    """
    positions = np.column_stack(hexagonal_positions(actuators, PITCH))
    radius = 11e-3 * ring_count(actuators) / 3
    points = edge_clustered_points(max(500, 2 * actuators))
    sag = STROKE * plate_influence(radius * np.column_stack([points.x, points.y]), positions, PlateProperties())
    weights = np.sqrt(points.weight)[:, None]
    matrix = weights * remove_piston_tilt(sag.T, points).T
    ridge = (RIDGE_SHARE * float(np.median(np.linalg.norm(matrix, axis=0)))) ** 2
    limits = Limits(-1.0, 1.0, np.zeros((0, 2), dtype=np.intp), 2.0)
    return Problem(BoundedProgramme(matrix, limits, ridge), matrix, ridge, weights * basis(points.x, points.y))


def targets(task: Problem, depth: tuple[float, float], count: int, generator: np.random.Generator) -> list[Floats]:
    """Right-hand sides: defocus of either sign of `depth` (m, least and most), and a little of all other terms."""
    result = []
    for share in np.linspace(0.0, 1.0, count):
        coefficients = generator.normal(size=len(TERMS)) * 0.05e-6
        coefficients[3] = (depth[0] + share * (depth[1] - depth[0])) * generator.choice([-1.0, 1.0])
        coefficients[:3] = 0.0
        result.append(task.terms @ coefficients)
    return result


def measure(effort: Effort, _rivals: dict[str, ModuleType]) -> dict[str, Any]:
    """Figure `solve`; times in ms over commands that saturate, `inside_ms` over commands that do not."""
    generator = np.random.default_rng(37)
    task = problem(37)
    saturating = targets(task, SATURATING, SATURATED_TARGETS, generator)
    inside = targets(task, (0.2e-6, 0.8e-6), 4, generator)
    stacked = np.vstack([task.matrix, np.sqrt(task.ridge) * np.eye(task.matrix.shape[1])])
    orthogonal, triangle = np.linalg.qr(stacked)
    projection = orthogonal[: len(task.matrix)].T

    def bvls(wanted: Floats) -> Floats:
        """Solve on the triangular factor, in favour of BVLS: it is as small as what the programme works on."""
        result: Floats = lsq_linear(triangle, projection @ wanted, (-1.0, 1.0), "bvls", max_iter=2000).x
        return result

    solve = task.programme.solve
    ours, theirs, costs = [], [], []
    for wanted in saturating:
        seconds = medians({"ours": partial(solve, wanted), "bvls": partial(bvls, wanted)}, effort.rounds, {"bvls": 5})
        ours.append(seconds["ours"])
        theirs.append(seconds["bvls"])
        clipped = np.clip(np.linalg.solve(triangle, projection @ wanted), -1.0, 1.0)
        found = [np.linalg.norm(task.matrix @ s - wanted) for s in (solve(wanted), bvls(wanted), clipped)]
        costs.append(found)
    residual = np.array(costs)
    at_limit = [int(task.programme.limits.at_limit(solve(wanted)).sum()) for wanted in saturating]
    inside_s = [medians({"inside": partial(solve, wanted)}, effort.rounds)["inside"] for wanted in inside]
    return {
        "solve": {
            "ms": 1e3 * float(np.median(ours)),
            "p95_ms": 1e3 * float(np.percentile(ours, 95)),
            "inside_ms": 1e3 * float(np.median(inside_s)),
            "bvls_ms": 1e3 * float(np.median(theirs)),
            "saturated_actuators": float(np.median(at_limit)),
            "residual_over_bvls": float(np.max(residual[:, 0] / residual[:, 1])),
            "clipped_residual_over_ours": float(np.median(residual[:, 2] / residual[:, 0])),
        }
    }
