"""The solvers that closed loops offer, by name."""

from collections.abc import Collection

from numpy.typing import ArrayLike

from dm_common.errors import UnknownNameError
from dm_common.limits import Limits
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel
from dm_controller.solvers.base import Solver
from dm_controller.solvers.least_squares import AZreg, AZWreg, Bounded, IterativeLearning, PseudoInverse

#: The method taken when none is named.
DEFAULT = Bounded.name
#: In the order of [1].
SOLVERS: dict[str, type[Solver]] = {
    solver.name: solver for solver in (PseudoInverse, IterativeLearning, AZreg, AZWreg, Bounded)
}


def named(name: str, solvers: Collection[str]) -> str:
    """`name`, or the default for "". Raises UnknownNameError, listing all `solvers`, if it is none of them."""
    if not name:
        return DEFAULT
    if name not in solvers:
        raise UnknownNameError(f"method = {name!r}: unknown; must be one of {', '.join(solvers)}")
    return name


def make_solver(
    name: str,
    model: InfluenceModel,
    limits: Limits,
    region_weights: ArrayLike | None = None,
    mirror: CalibratedMirror | None = None,
) -> Solver:
    """The solver of that name ("" = the default) for one mirror.

    `region_weights` are for `AZWreg`, `mirror` for `Bounded`: see there.

    Raises:
        UnknownNameError: no such method, listing all.
        ValueError: the model does not suit the method.
    """
    solver = SOLVERS[named(name, SOLVERS)]
    if solver is Bounded:
        return Bounded(model, limits, mirror)
    return AZWreg(model, limits, region_weights) if solver is AZWreg else solver(model, limits)
