"""All solvers on a mirror whose response is known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_common.errors import UnknownNameError
from dm_common.limits import Limits
from dm_common.optics.zernike import PISTON_TILT
from dm_controller.planning.mirror_model import CalibratedMirror, InfluenceModel, target_shape
from dm_controller.planning.target import FocusTarget
from dm_controller.solvers.base import Shape, Solver, rms_sag
from dm_controller.solvers.least_squares import AZWreg, IterativeLearning, PseudoInverse
from dm_controller.solvers.registry import DEFAULT
from dm_simulation.mirror.plate import Plate
from linear_mirror import LinearMirror, hexagon, make_mirror
from perfect_calibration import perfect_model
from studies.solvers.plate_model import PlateProperties, plate_influence
from studies.solvers.registry import SOLVERS, MirrorFacts, check_method, make_solver
from studies.solvers.sparse import SparseSampling
from studies.solvers.steepest_descent import SteepestDescent

PAIRS = np.asarray(make_mirror().limits.pairs, dtype=np.intp)
X, Y = hexagon()
FACTS = MirrorFacts(X, Y)
#: Methods that meet the 21 coefficients exactly as long as no limit is in the way.
EXACT = ("pseudo_inverse", "sparse_sampling", "AZreg", "bounded")


@pytest.fixture(scope="module")
def mirror() -> LinearMirror:
    return LinearMirror(X, Y)


@pytest.fixture(scope="module")
def model(mirror: LinearMirror) -> InfluenceModel:
    return perfect_model(mirror)


def limits(neighbour_difference: float = 2.0) -> Limits:
    return Limits(-1.0, 1.0, PAIRS, neighbour_difference)


def surface(mirror: LinearMirror, signals: np.ndarray) -> Shape:
    sag = mirror.sag(signals)
    return Shape(mirror.fit_terms(sag), sag)


def solver_of(name: str, model: InfluenceModel, neighbour_difference: float = 2.0) -> Solver:
    return make_solver(name, model, limits(neighbour_difference), FACTS)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("curvature", [-0.02, 0.0, 0.03])
def test_exact_methods_give_the_wanted_coefficients(
    name: str, curvature: float, mirror: LinearMirror, model: InfluenceModel
) -> None:
    wanted = target_shape(FocusTarget(curvature), model)
    command = solver_of(name, model).solve(wanted)
    assert command.overflow == 0.0
    assert (surface(mirror, command.signals) - wanted).max_zernike < 5e-11


@pytest.mark.parametrize("name", list(SOLVERS))
def test_every_method_improves_on_the_flat_mirror_and_on_its_own_error(
    name: str, mirror: LinearMirror, model: InfluenceModel
) -> None:
    solver, wanted = solver_of(name, model), target_shape(FocusTarget(0.03), model)
    at_rest = (surface(mirror, np.zeros(37)) - wanted).max_zernike
    first = solver.solve(wanted)
    error = surface(mirror, first.signals) - wanted
    assert error.max_zernike < 0.25 * at_rest
    # The true mirror answers 10 % more weakly than the model says.
    weak = 0.9 * first.signals
    off = surface(mirror, weak) - wanted
    better = surface(mirror, weak + 0.9 * (solver.correct(weak, off).signals - weak)) - wanted
    assert rms_sag(better, model) < rms_sag(off, model)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_limits_hold_for_impossible_demands(name: str, model: InfluenceModel) -> None:
    for difference in (2.0, 0.2):
        solver = solver_of(name, model, difference)
        wanted = target_shape(FocusTarget(0.4), model)
        command = solver.solve(wanted)
        assert limits(difference).allow(command.signals)
        assert limits(difference).allow(solver.correct(command.signals, -wanted).signals)


def test_the_pseudo_inverse_says_by_how_much_it_was_cut(model: InfluenceModel) -> None:
    solver = solver_of("pseudo_inverse", model)
    wanted = target_shape(FocusTarget(0.4), model)
    free = PseudoInverse(model, Limits(-100.0, 100.0, PAIRS, 200.0)).solve(wanted).signals
    assert solver.solve(wanted).overflow == pytest.approx(np.abs(free).max() - 1.0)


def test_the_pseudo_inverse_is_the_shortest_of_all_solutions(model: InfluenceModel) -> None:
    wanted = target_shape(FocusTarget(0.03), model)
    change = (wanted - model.offset).coefficients[PISTON_TILT:]
    shortest = np.linalg.lstsq(model.influence_zernike[PISTON_TILT:], change)[0]
    np.testing.assert_allclose(solver_of("pseudo_inverse", model).solve(wanted).signals, shortest, atol=1e-9)


def test_the_bounded_solver_agrees_with_the_controller(model: InfluenceModel) -> None:
    for curvature in (0.02, 0.3):
        target = FocusTarget(curvature)
        planned = CalibratedMirror(model, limits()).plan(target).signals
        solved = solver_of("bounded", model).solve(target_shape(target, model)).signals
        np.testing.assert_allclose(solved, planned, atol=1e-7)


def test_the_bounded_solver_leaves_less_sag_than_the_pseudo_inverse(
    mirror: LinearMirror, model: InfluenceModel
) -> None:
    wanted = target_shape(FocusTarget(0.03), model)
    left = {
        name: rms_sag(surface(mirror, solver_of(name, model).solve(wanted).signals) - wanted, model)
        for name in ("bounded", "pseudo_inverse")
    }
    assert left["bounded"] < left["pseudo_inverse"]


def test_steepest_descent_corrects_less_per_map_than_the_pseudo_inverse(
    mirror: LinearMirror, model: InfluenceModel
) -> None:
    wanted = target_shape(FocusTarget(0.02), model)
    start = np.zeros(37)
    error = surface(mirror, start) - wanted
    left = {}
    for kind in (SteepestDescent, PseudoInverse):
        signals = kind(model, limits()).correct(start, error).signals
        left[kind.name] = (surface(mirror, signals) - wanted).max_zernike
    assert left["pseudo_inverse"] < 1e-10 < left["steepest_descent"] < error.max_zernike


def test_a_smaller_beta_learns_faster(mirror: LinearMirror, model: InfluenceModel) -> None:
    wanted = target_shape(FocusTarget(0.02), model)
    left = [
        (surface(mirror, IterativeLearning(model, limits(), beta).solve(wanted).signals) - wanted).max_zernike
        for beta in (1e-1, 1e-2, 1e-4)
    ]
    assert left[0] > left[1] > left[2]
    with pytest.raises(ValueError, match="beta = 0: must be above 0"):
        IterativeLearning(model, limits(), 0.0)


def test_theta_is_sparse_and_its_patterns_make_the_change(model: InfluenceModel) -> None:
    solver = SparseSampling(model, limits())
    change = target_shape(FocusTarget(0.02), model) - model.offset
    theta = solver.theta(np.zeros(37), change)
    # A vertex of the linear programme has no more non-zero unknowns than equations.
    assert np.count_nonzero(np.abs(theta) > 1e-9 * np.abs(theta).max()) <= len(model.zernike_offset) - PISTON_TILT
    np.testing.assert_allclose(
        model.influence_zernike[PISTON_TILT:] @ solver.patterns @ theta, change.coefficients[PISTON_TILT:], atol=1e-11
    )
    single = np.abs(solver.theta(np.zeros(37), Shape(np.zeros(21), np.zeros(len(model.points.x)))))
    assert single.max() == 0.0


def test_small_corrections_are_as_exact_as_large_ones(mirror: LinearMirror, model: InfluenceModel) -> None:
    solver = solver_of("sparse_sampling", model)
    wanted = target_shape(FocusTarget(0.02), model)
    signals = solver.solve(wanted).signals
    nudged = signals + 1e-4
    error = surface(mirror, nudged) - wanted
    corrected = surface(mirror, solver.correct(nudged, error).signals) - wanted
    assert corrected.max_zernike < 1e-2 * max(error.max_zernike, 1e-9)


def test_region_weights_move_the_error_out_of_the_heavy_region(mirror: LinearMirror, model: InfluenceModel) -> None:
    wanted = target_shape(FocusTarget(0.1, zernike=(*[0.0] * 20, 3e-7)), model)
    inner = np.hypot(model.points.x, model.points.y) < 0.5
    left = {}
    for name, weights in (("equal", None), ("inner", [1.0] * 3 + [0.05] * 7)):
        signals = AZWreg(model, Limits(-100.0, 100.0, PAIRS, 200.0), weights).solve(wanted).signals
        error = (surface(mirror, signals) - wanted).sag[inner]
        plane = np.column_stack([np.ones(inner.sum()), model.points.x[inner], model.points.y[inner]])
        error -= plane @ np.linalg.lstsq(plane, error)[0]
        left[name] = float(np.sqrt(np.mean(error**2)))
    assert left["inner"] < left["equal"]


def test_the_plate_model_resembles_a_free_edge_plate() -> None:
    """Mechanics against mechanics: spline on springs against the simulation's Rayleigh-Ritz solution, inside 22 mm."""
    plate = Plate()
    grid = np.linspace(-0.011, 0.011, 23)
    x, y = (part.ravel() for part in np.meshgrid(grid, grid))
    inside = np.hypot(x, y) <= 0.011
    at = np.column_stack([x, y])[inside]
    properties = PlateProperties(
        plate.config.thickness,
        plate.config.youngs_modulus,
        plate.config.poisson_ratio,
        plate.config.spring_stiffness,
    )
    analytic = plate_influence(at, np.column_stack([plate.x, plate.y]), properties)
    ritz = plate.influence_at(at[:, 0], at[:, 1])
    difference = np.linalg.norm(analytic - ritz, axis=0) / np.linalg.norm(ritz, axis=0)
    # The edge, which the spline does not know, lies 2.1 mm outside the last ring.
    assert difference[:19].max() < 0.05
    assert difference[19:].max() < 0.2
    # All bases moved alike, or in a plane, move the plate as it is.
    np.testing.assert_allclose(analytic.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(analytic @ plate.x, at[:, 0], atol=1e-11)


def test_the_default_and_unknown_names() -> None:
    assert check_method("") == DEFAULT == "bounded"
    with pytest.raises(
        UnknownNameError, match=r"method = 'AZREG': unknown; must be one of pseudo_inverse, .*, bounded"
    ):
        check_method("AZREG")


def test_every_solver_has_a_name() -> None:
    assert len(SOLVERS) == 8
    for cls in Solver.__subclasses__():
        assert cls.name in SOLVERS


def test_the_plate_model_needs_positions(model: InfluenceModel) -> None:
    with pytest.raises(ValueError, match="plate_model needs the actuator positions"):
        make_solver("plate_model", model, limits())
    with pytest.raises(ValueError, match="must be 37 each"):
        make_solver("plate_model", model, limits(), MirrorFacts(X[:5], Y[:5]))
    with pytest.raises(ValueError, match="thickness = 0"):
        PlateProperties(thickness=0.0)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_bad_shapes_and_signals_are_refused(name: str, model: InfluenceModel) -> None:
    solver, wanted = solver_of(name, model), target_shape(FocusTarget(0.01), model)
    with pytest.raises(ValueError, match=r"coefficients has the shape \(5,\): must be \(21,\)"):
        solver.solve(Shape(wanted.coefficients[:5], wanted.sag))
    with pytest.raises(ValueError, match=r"sag holds values that are not finite"):
        solver.solve(Shape(wanted.coefficients, np.full_like(wanted.sag, np.nan)))
    with pytest.raises(ValueError, match=r"signals has the shape \(3,\): must be \(37,\)"):
        solver.correct(np.zeros(3), wanted)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_dead_mirror_is_refused(name: str, model: InfluenceModel) -> None:
    dead = replace(
        model,
        influence_zernike=np.zeros_like(model.influence_zernike),
        influence_sag=np.zeros_like(model.influence_sag),
    )
    with pytest.raises(ValueError, match=r"no actuator moves the surface|does not determine every signal"):
        make_solver(name, dead, limits(), FACTS)
