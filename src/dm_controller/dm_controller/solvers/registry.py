"""The solvers that closed loops offer, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

from dm_common.limits import Limits
from dm_common.names import UnknownNameError
from dm_controller.planning.mirror_model import InfluenceModel
from dm_controller.solvers.base import Floats, Solver
from dm_controller.solvers.least_squares import AZreg, AZWreg, Bounded, IterativeLearning, PseudoInverse

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


Factory = Callable[[InfluenceModel, Limits, MirrorFacts], Solver]

#: Makers by name, in the order of [1].
SOLVERS: dict[str, Factory] = {
    PseudoInverse.name: lambda model, limits, facts: PseudoInverse(model, limits),
    IterativeLearning.name: lambda model, limits, facts: IterativeLearning(model, limits),
    AZreg.name: lambda model, limits, facts: AZreg(model, limits),
    AZWreg.name: lambda model, limits, facts: AZWreg(model, limits, facts.region_weights),
    Bounded.name: lambda model, limits, facts: Bounded(model, limits),
}


def named(name: str, solvers: Mapping[str, Factory]) -> str:
    """`name`, or the default for "".

    Raises:
        UnknownNameError: none of `solvers`, listing all.
    """
    if not name:
        return DEFAULT
    if name not in solvers:
        raise UnknownNameError(f"method = {name!r}: unknown; must be one of {', '.join(solvers)}")
    return name


def make_solver(name: str, model: InfluenceModel, limits: Limits, facts: MirrorFacts | None = None) -> Solver:
    """The solver of that name ("" = the default) for one mirror.

    Raises:
        UnknownNameError: no such method, listing all.
        ValueError: the model, or what is known of the mirror, does not do for the method.
    """
    return SOLVERS[named(name, SOLVERS)](model, limits, facts or MirrorFacts())
