"""What is not known of creep: how well a run shows its spectrum, and the bounds that follow from that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dm_calibration.hysteresis.creep_uncertainty import OWN, SHARED, SHARED_CORRELATION, creep_covariance
from dm_calibration.hysteresis.excitation import excitation
from dm_calibration.hysteresis.features import follow
from dm_calibration.hysteresis.responses import Responses
from dm_calibration.hysteresis.run import Run
from dm_common import Floats
from dm_common.hysteresis.creep_record import UNSEEN, record_of, rested
from dm_common.hysteresis.model import CREEP_TIMES, HysteresisModel
from dm_controller.planning import creep_error as creep_error_module
from dm_controller.planning.creep_error import IN_FIGURE_S, CreepError, CreepShown
from linear_mirror import make_mirror

MIRROR = make_mirror(rings=1)
COUNT = MIRROR.actuators
#: m per unit signal of each coefficient.
RESPONSE = 1e-6 * np.random.default_rng(5).standard_normal((12, COUNT))
CREEPS = replace(HysteresisModel.linear(), creep_rate=0.01, creep_time=CREEP_TIMES)


def run_of(law: HysteresisModel, maps: int, noise: float = 2e-10, seed: int = 1, response: Floats = RESPONSE) -> Run:
    commands = excitation(MIRROR, maps)
    time = np.cumsum(0.5 + 0.5 * commands.settle_share + commands.dwell)
    effective, _ = follow(law, law.demagnetised(COUNT, 0.0), commands.signals, time)
    values = effective @ response.T + noise * np.random.default_rng(seed).standard_normal((maps, len(response)))
    return Run(commands.signals, time, Responses(values, len(RESPONSE), np.ones(maps, dtype=bool)), 0.0)


def relative(covariance: Floats) -> Floats:
    """(J,) standard deviation of each element's weight as a share of it."""
    return np.asarray(np.sqrt(np.diag(covariance)[1:]) / CREEPS.creep_share)


def test_maps_tell_creep_of_their_own_age_and_leave_the_rest_to_the_prior() -> None:
    shared, each = creep_covariance(run_of(CREEPS, 300), CREEPS)
    sigma = relative(shared)
    seconds = (CREEP_TIMES > 0.5) & (CREEP_TIMES < 30.0)
    assert (sigma[seconds] < 0.3 * SHARED).all()
    assert sigma[-1] == pytest.approx(SHARED, rel=0.2)
    assert sigma[0] > 0.5 * SHARED
    assert (relative(each) < 1.01 * OWN).all()
    few, _ = creep_covariance(run_of(CREEPS, 80, noise=2e-9), CREEPS)
    assert (relative(few)[seconds] > sigma[seconds]).all()


def test_maps_that_all_actuators_err_in_together_count_for_less() -> None:
    """A law that lacks something, such as loops that widen with speed, errs by a pattern, not by noise of each map."""
    run = run_of(CREEPS, 300)
    together = 2e-10 * np.random.default_rng(2).standard_normal((300, 1)) * RESPONSE.sum(axis=1) / RESPONSE.std()
    erring = replace(run, responses=replace(run.responses, values=run.responses.values + together))
    seconds = (CREEP_TIMES > 0.5) & (CREEP_TIMES < 30.0)
    noisy = run_of(CREEPS, 300, noise=float(np.hypot(2e-10, together.std())))
    sigma, usual = (relative(creep_covariance(one, CREEPS)[0])[seconds] for one in (erring, noisy))
    assert (sigma > 1.1 * usual).all()


def test_maps_that_are_followed_more_closely_than_others_are_predicted_count_for_less() -> None:
    run = run_of(CREEPS, 300)
    held_out = np.full_like(run.responses.values, np.nan)
    held_out[::10] = 6e-10 * np.random.default_rng(4).standard_normal(held_out[::10].shape)
    seconds = (CREEP_TIMES > 0.5) & (CREEP_TIMES < 30.0)
    for usual, wider in zip(creep_covariance(run, CREEPS), creep_covariance(run, CREEPS, held_out), strict=True):
        assert (relative(wider)[seconds] > 1.2 * relative(usual)[seconds]).all()
    as_well = creep_covariance(run, CREEPS, np.where(np.isfinite(held_out), 1e-10, np.nan))
    np.testing.assert_array_equal(as_well, creep_covariance(run, CREEPS))


@pytest.mark.parametrize("dead", [1, 4])
def test_a_dead_actuator_is_known_no_better_than_before_the_run(dead: int) -> None:
    alive = np.ones(COUNT)
    alive[:dead] = 0.0
    run = run_of(CREEPS, 150, response=RESPONSE * alive)
    each = creep_covariance(run, CREEPS)[1]
    # A mean over actuators, of which the dead ones have what the prior gives.
    assert (relative(each) > np.sqrt(dead / COUNT) * OWN).all()
    assert (relative(each) < OWN).all()
    assert np.linalg.eigvalsh(each).min() > 0.0


@pytest.mark.parametrize("few", [1, 3])
def test_a_few_actuators_are_told_apart(few: int) -> None:
    run = run_of(CREEPS, 150, response=RESPONSE * (np.arange(COUNT) < few))
    each = creep_covariance(replace(run, signals=run.signals[:, :few]), CREEPS)[1]
    assert (relative(each) < OWN).all() and np.linalg.eigvalsh(each).min() > 0.0


def test_data_without_noise_are_believed_as_far_as_they_can_be() -> None:
    covariance = creep_covariance(run_of(CREEPS, 150, noise=0.0), CREEPS)
    assert np.isfinite(covariance).all()
    for one in covariance:
        assert np.linalg.eigvalsh(one).min() > 0.0


def test_a_run_is_as_sure_of_creep_as_it_may_be() -> None:
    """Spectra drawn from the prior: what creep adds over ten minutes lies within three standard deviations."""
    rng = np.random.default_rng(3)
    apart = np.abs(np.subtract.outer(np.arange(len(CREEP_TIMES)), np.arange(len(CREEP_TIMES))))
    root = np.linalg.cholesky(np.exp(-apart / SHARED_CORRELATION))
    grown = np.concatenate(([0.0], 1.0 - np.exp(-600.0 / CREEP_TIMES)))
    covariance = creep_covariance(run_of(CREEPS, 150), CREEPS)[0]
    sigma = float(np.sqrt(grown @ covariance @ grown))
    spread = float(np.std([grown[1:] @ (0.01 * 0.5 * SHARED * (root @ rng.standard_normal(15))) for _ in range(200)]))
    assert sigma < 0.5 * spread


def creep_error(law: HysteresisModel, shown: CreepShown | None = None) -> CreepError:
    return CreepError(law, RESPONSE, 1e-6 * np.eye(COUNT), np.full(COUNT, 0.8), shown)


@pytest.mark.parametrize("age", [10.0, 1000.0])
def test_a_held_shape_stays_inside_its_bound(age: float) -> None:
    """Weights of slow elements err as the covariance says; the hold corrects by those of the law."""
    covariance = creep_covariance(run_of(CREEPS, 150), CREEPS)
    slow = np.concatenate(([False], CREEP_TIMES > 100.0))
    covariance *= np.outer(slow, slow)
    law, position = replace(CREEPS, creep_covariance=covariance), np.linspace(-0.5, 0.5, COUNT)
    bound = creep_error(law).bound(law.demagnetised(COUNT, 0.0), position, 0.05).max_zernike
    rng, followed = np.random.default_rng(6), np.concatenate(([1.0], 1.0 - np.exp(-age / CREEP_TIMES)))
    shared, each = (
        rng.multivariate_normal(np.zeros(len(followed)), one, (500, COUNT)) @ followed for one in covariance
    )
    errors = np.abs(((shared[:, :1] + each) * position) @ RESPONSE.T).max(axis=1)
    assert np.mean(errors < bound) >= 0.95


def test_what_was_held_unseen_widens_the_bound_until_it_has_faded() -> None:
    law = replace(CREEPS, creep_covariance=creep_covariance(run_of(CREEPS, 150), CREEPS))
    error, position = creep_error(law), np.linspace(-0.5, 0.5, COUNT)
    known = law.demagnetised(COUNT, 0.0)
    guessed = rested(law, np.zeros(COUNT), 0.0)
    bounds = [error.bound(law.advance(guessed, 10.0**decade), position, 0.05).max_zernike for decade in range(7)]
    assert (np.diff(bounds) < 0.0).all()
    assert bounds[0] > 1.5 * error.bound(known, position, 0.05).max_zernike
    assert bounds[-1] == pytest.approx(error.bound(known, position, 0.05).max_zernike, rel=0.2)


@pytest.mark.parametrize("lag", [0.0, -0.5, 2.0])
def test_the_bound_holds_where_power_was_off_unseen(lag: float) -> None:
    """A shape of the whole range was believed to stand for ten minutes, and its creep had faded to that of no shape.

    What loops follow otherwise than the straight part (`lag`) makes no difference: a shape is both.
    """
    law = CREEPS
    if lag:
        spectrum = np.ones(len(CREEP_TIMES))
        spectrum[:7] -= lag
        law = replace(CREEPS, creep_spectrum=spectrum, lag_spectrum=np.full(7, lag))
    law = replace(law, creep_covariance=np.zeros((2, 1 + len(CREEP_TIMES), 1 + len(CREEP_TIMES))))
    whole = np.linspace(-0.5, 0.5, COUNT)
    error = CreepError(law, RESPONSE, np.zeros((COUNT, COUNT)), whole)
    held = law.advance(law.move(law.demagnetised(COUNT, 0.0), whole, 0.0), 86_400.0)
    record = record_of(law, held, 86_400.0)
    believed = law.degaussed(rested(law, whole, 87_000.0, 0.0, record), 87_000.0)
    off = law.advance(law.move(held, np.zeros(COUNT), 86_400.0), 87_000.0)
    for later in (1.0, 60.0, 3600.0):
        gap = law.effective(law.advance(off, 87_000.0 + later)) - law.effective(law.advance(believed, 87_000.0 + later))
        wrong = np.abs(RESPONSE @ gap).max()
        bound = error.bound(believed, np.zeros(COUNT), later).max_zernike
        assert 0.9 * wrong < bound < 3.0 * wrong


def test_a_degauss_does_not_make_old_creep_known() -> None:
    guessed = rested(CREEPS, np.zeros(COUNT), 0.0)
    after = CREEPS.degaussed(CREEPS.advance(guessed, 5.0), 10.0)
    assert after.crept_sigma[-1] == pytest.approx(UNSEEN, rel=1e-3)
    assert after.crept_sigma[0] < 1e-9


def test_after_a_calibration_only_what_came_later_is_in_doubt() -> None:
    law = replace(CREEPS, crept_at=1000.0, crept=np.full(COUNT, 0.3))
    soon, late = (rested(law, np.zeros(COUNT), 1000.0 + elapsed).crept_sigma for elapsed in (60.0, 86_400.0))
    assert soon[-1] < 1e-3
    assert late[-4] > 0.9 * UNSEEN


@pytest.fixture
def seconds_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds for ages far below the time that old creep takes to fade, to judge what was left at their beginning."""
    monkeypatch.setattr(creep_error_module, "AGES", (1.0, 10.0, 100.0))


@pytest.mark.usefixtures("seconds_only")
def test_what_was_held_before_a_calibration_is_in_doubt_while_it_fades() -> None:
    """Its size is known, of which actuators it was is not: what differs by half of it fades within the bound."""
    rng = np.random.default_rng(7)
    sure = np.zeros((2, 1 + len(CREEP_TIMES), 1 + len(CREEP_TIMES)))
    law = replace(CREEPS, creep_covariance=sure, crept_at=1000.0, crept=0.3 * rng.standard_normal(COUNT))
    error, rest, state = creep_error(law), np.zeros(COUNT), law.demagnetised(COUNT, 1000.0)
    hours = [error.bound(law.advance(state, 1000.0 + 3600.0 * hour), rest, 0.05).max_zernike for hour in (0.1, 1, 3)]
    assert hours == sorted(hours)
    faded = np.exp(-(3 * 3600.0) / CREEP_TIMES) - np.exp(-IN_FIGURE_S / CREEP_TIMES)
    size = 0.5 * np.sqrt(np.mean(np.square(law.crept)))
    others = size * rng.standard_normal((400, COUNT)) @ RESPONSE.T * (law.creep_share @ faded)
    assert 0.85 < np.mean(np.abs(others).max(axis=1) < hours[-1]) < 1.0
    # A recipe measured meanwhile shows what was left then.
    built = [error.bound(law.advance(state, 11800.0), rest, 0.05, at).max_zernike for at in (0.0, 4600.0, 11800.0)]
    assert built[0] == pytest.approx(hours[-1]) and 0.0 < built[1] < 0.7 * built[0] and built[2] < 0.01 * built[0]


@pytest.mark.usefixtures("seconds_only")
def test_a_recipe_includes_the_old_creep_of_when_it_was_measured() -> None:
    """A calibration right after power-on: the mirror stood elsewhere before, and recipes follow within the hour."""
    crept = 0.5 * np.random.default_rng(7).standard_normal(COUNT)
    covariance = creep_covariance(run_of(CREEPS, 150), CREEPS)
    law = replace(CREEPS, creep_covariance=covariance, crept_at=1000.0, crept=crept)
    rest, state = np.zeros(COUNT), law.demagnetised(COUNT, 1000.0)
    state = replace(state, crept=np.repeat(crept[:, None], len(CREEP_TIMES), axis=1))
    error, times = creep_error(law), (3000.0, 3600.0, 90_000.0)
    direct, *built = (
        [error.bound(law.advance(state, time), rest, 0.05, measured).max_zernike for time in times]
        for measured in (None, 3000.0, 0.0)
    )
    assert built[0] == sorted(built[0]) and built[0][1] < 0.2 * direct[1] < 0.2 * direct[2] < built[0][2]
    assert built[1] == pytest.approx(direct, rel=0.05)  # one that was measured in the run
    # Later maps shift a recipe that was built before them as they shift the figure.
    now = law.advance(state, times[-1])
    checked = creep_error(law, CreepShown(now.time, now.crept, now.crept_sigma, 1.0))
    assert checked.bound(now, rest, 0.05, 3000.0).max_zernike < 0.2 * built[0][2]


def test_bounds_count_creep_from_the_last_check_on() -> None:
    """A shape held for a day, partly unseen; after it maps show what it left, and later another is held for hours."""
    law = replace(CREEPS, creep_covariance=creep_covariance(run_of(CREEPS, 150), CREEPS))
    rest, shape = np.zeros(COUNT), np.linspace(-0.5, 0.5, COUNT)
    held = law.advance(law.move(rested(law, rest, 0.0), shape, 0.0), 86_400.0)
    checked = law.degaussed(held, 86_400.0)

    moved = law.move(checked, -shape, 86_460.0)
    states = [law.advance(checked, 86_460.0), law.advance(checked, 90_000.0), law.advance(moved, 100_000.0)]

    def bounds(share: float | None) -> list[float]:
        shown = None if share is None else CreepShown(checked.time, checked.crept, checked.crept_sigma, share)
        error = creep_error(law, shown)
        return [error.bound(state, rest, 0.05).max_zernike for state in states]

    whole, half, none = bounds(1.0), bounds(0.5), bounds(0.0)
    assert none == pytest.approx(bounds(None))
    assert whole[0] < 0.3 * none[0] and whole[0] < half[0] < none[0]
    assert whole[0] < 0.8 * whole[1]  # what was shown fades, and the figure does not
    assert whole[2] > 0.8 * none[2]  # what was held since is as uncertain as ever


def test_recipes_and_figure_count_what_fades_after_a_check_alike() -> None:
    """Maps shift both by what was held unseen; the recipe by nothing else here, since its creep is known."""
    law = replace(CREEPS, creep_covariance=np.zeros((2, 1 + len(CREEP_TIMES), 1 + len(CREEP_TIMES))))
    rest = np.zeros(COUNT)
    checked = law.degaussed(rested(law, rest, 0.0), 60.0)
    error = creep_error(law, CreepShown(checked.time, checked.crept, checked.crept_sigma, 1.0))
    later = law.advance(checked, 30_000.0)
    figure, recipe = (error.bound(later, rest, 0.05, measured).max_zernike for measured in (None, 0.0))
    assert recipe == pytest.approx(figure) and recipe > 2.0 * error.bound(checked, rest, 0.05, 0.0).max_zernike


def test_a_longer_move_is_known_less_well() -> None:
    error = creep_error(CREEPS)
    state = CREEPS.demagnetised(COUNT, 0.0)
    small, large = (error.bound(state, size * np.linspace(-0.5, 0.5, COUNT), 0.05) for size in (0.1, 1.0))
    assert large.max_zernike == pytest.approx(10.0 * small.max_zernike)
    assert large.rms == pytest.approx(10.0 * small.rms)
