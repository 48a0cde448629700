"""All solvers by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import ArrayLike

from dm_calibration.names import UnknownNameError
from dm_controller.model import InfluenceModel
from dm_controller.solvers.base import Floats, Solver
from dm_controller.solvers.bounded import Limits
from dm_controller.solvers.bounded_command import Bounded
from dm_controller.solvers.iterative_learning import IterativeLearning
from dm_controller.solvers.plate_model import PlateModel
from dm_controller.solvers.pseudo_inverse import AZreg, PseudoInverse
from dm_controller.solvers.region_weighted import AZWreg
from dm_controller.solvers.sparse import SparseSampling
from dm_controller.solvers.steepest_descent import SteepestDescent

#: The method taken when none is named.
DEFAULT = Bounded.name


@dataclass(frozen=True, eq=False)
class MirrorFacts:
    """What some methods need beside the influence function.

    Attributes:
        actuator_x, actuator_y: (N,) m; None = unknown.
        region_weights: (10,) Eq. (8); None = all equal.
    """

    actuator_x: Floats | None = None
    actuator_y: Floats | None = None
    region_weights: ArrayLike | None = None


def _plate(model: InfluenceModel, limits: Limits, facts: MirrorFacts) -> Solver:
    if facts.actuator_x is None or facts.actuator_y is None:
        raise ValueError("plate_model needs the actuator positions: give actuator_x and actuator_y (m)")
    return PlateModel(model, limits, facts.actuator_x, facts.actuator_y)


Factory = Callable[[InfluenceModel, Limits, MirrorFacts], Solver]

#: Makers by name, in the order of the paper.
SOLVERS: dict[str, Factory] = {
    PseudoInverse.name: lambda model, limits, facts: PseudoInverse(model, limits),
    SteepestDescent.name: lambda model, limits, facts: SteepestDescent(model, limits),
    IterativeLearning.name: lambda model, limits, facts: IterativeLearning(model, limits),
    SparseSampling.name: lambda model, limits, facts: SparseSampling(model, limits),
    PlateModel.name: _plate,
    AZreg.name: lambda model, limits, facts: AZreg(model, limits),
    AZWreg.name: lambda model, limits, facts: AZWreg(model, limits, facts.region_weights),
    Bounded.name: lambda model, limits, facts: Bounded(model, limits),
}


def check_method(name: str) -> str:
    """`name`, or the default for "".

    Raises:
        UnknownNameError: no such method, listing all.
    """
    if not name:
        return DEFAULT
    if name not in SOLVERS:
        raise UnknownNameError(f"method = {name!r}: unknown; must be one of {', '.join(SOLVERS)}")
    return name


def make_solver(name: str, model: InfluenceModel, limits: Limits, facts: MirrorFacts | None = None) -> Solver:
    """The solver of that name ("" = the default) for one mirror.

    Raises:
        UnknownNameError: no such method, listing all.
        ValueError: the model, or what is known of the mirror, does not do for the method.
    """
    return SOLVERS[check_method(name)](model, limits, facts or MirrorFacts())
