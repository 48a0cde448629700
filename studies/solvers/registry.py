"""All solvers that are compared, by name: those that the controller offers, and three that only serve comparison."""

from __future__ import annotations

from dm_common.limits import Limits
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Solver
from dm_controller.solvers.registry import SOLVERS as OFFERED
from dm_controller.solvers.registry import Factory, MirrorFacts, named
from studies.solvers.plate_model import PlateModel
from studies.solvers.sparse import SparseSampling
from studies.solvers.steepest_descent import SteepestDescent


def _plate(model: InfluenceModel, limits: Limits, facts: MirrorFacts) -> Solver:
    if facts.actuator_x is None or facts.actuator_y is None:
        raise ValueError("plate_model needs the actuator positions: give actuator_x and actuator_y (m)")
    return PlateModel(model, limits, facts.actuator_x, facts.actuator_y)


_COMPARED: dict[str, Factory] = OFFERED | {
    SteepestDescent.name: lambda model, limits, facts: SteepestDescent(model, limits),
    SparseSampling.name: lambda model, limits, facts: SparseSampling(model, limits),
    PlateModel.name: _plate,
}
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
#: Makers by name, in the order of [1].
SOLVERS = {name: _COMPARED[name] for name in sorted(_COMPARED, key=_ORDER.index)}


def check_method(name: str) -> str:
    """`name`, or the default for "". Raises UnknownNameError, listing all."""
    return named(name, SOLVERS)


def make_solver(name: str, model: InfluenceModel, limits: Limits, facts: MirrorFacts | None = None) -> Solver:
    """The solver of that name ("" = the default) for one mirror.

    Raises:
        UnknownNameError: no such method, listing all.
        ValueError: the model, or what is known of the mirror, does not do for the method.
    """
    return SOLVERS[check_method(name)](model, limits, facts or MirrorFacts())
