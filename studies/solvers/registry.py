"""All solvers that are compared, by name: those that the controller offers, and three that only serve comparison."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from dm_common import Floats
from dm_common.limits import Limits
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Solver
from dm_controller.solvers.registry import SOLVERS as OFFERED
from dm_controller.solvers.registry import make_solver as make_offered
from dm_controller.solvers.registry import named
from studies.solvers.plate_model import PlateModel
from studies.solvers.sparse import SparseSampling
from studies.solvers.steepest_descent import SteepestDescent


@dataclass(frozen=True, eq=False)
class MirrorFacts:
    """Facts that some methods need beside the influence function.

    Attributes:
        actuator_x, actuator_y: (N,) m; None = unknown.
        region_weights: (10,) Eq. (8); None = all equal.
    """

    actuator_x: Floats | None = None
    actuator_y: Floats | None = None
    region_weights: ArrayLike | None = None


_COMPARED = OFFERED | {solver.name: solver for solver in (SteepestDescent, SparseSampling, PlateModel)}
_ORDER = (
    "pseudo_inverse",
    "steepest_descent",
    "iterative_learning",
    "sparse_sampling",
    "plate_model",
    "AZreg",
    "AZWreg",
    "bounded",
)
#: All solvers by name, in the order of [1].
SOLVERS = {name: _COMPARED[name] for name in sorted(_COMPARED, key=_ORDER.index)}


def check_method(name: str) -> str:
    """`name`, or the default for "". Raises UnknownNameError, listing all."""
    return named(name, SOLVERS)


def make_solver(name: str, model: InfluenceModel, limits: Limits, facts: MirrorFacts | None = None) -> Solver:
    """The solver of that name ("" = the default) for one mirror.

    Raises:
        UnknownNameError: no such method, listing all.
        ValueError: the model, or the facts known of the mirror, are not sufficient for the method.
    """
    facts, solver = facts or MirrorFacts(), SOLVERS[check_method(name)]
    if solver is PlateModel:
        if facts.actuator_x is None or facts.actuator_y is None:
            raise ValueError("plate_model needs the actuator positions: give actuator_x and actuator_y (m)")
        return PlateModel(model, limits, facts.actuator_x, facts.actuator_y)
    if solver.name in OFFERED:
        return make_offered(solver.name, model, limits, facts.region_weights)
    return solver(model, limits)
