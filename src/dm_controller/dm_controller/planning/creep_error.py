"""Bounds of errors from creep that is not known: in the first second, over hours, and from shapes held unobserved."""

from typing import NamedTuple

import numpy as np

from dm_common import LARGEST_95, SIGMAS_95, Floats
from dm_common.hysteresis.creep_record import SLOW_S
from dm_common.hysteresis.model import HysteresisModel, HysteresisState

#: Ages of a shape, s, for which a bound holds, besides the moment when it is to be right.
AGES = (1.0, 10.0, 100.0, 1000.0)
#: The calibration's figure includes the creep left at this time after `crept_at`, s: half of a typical run.
IN_FIGURE_S = 200.0
#: Ages at which recipes are measured, s.
MEASURED_S = (1.0, 5.0)
#: Assumed relative error of creep: that of elements with time constants (s) below and above these two, if the
#: calibration has no covariance, and that of shapes held before the calibration.
UNKNOWN_SHARE, UNKNOWN_BELOW, UNKNOWN_ABOVE = 0.5, 1.0, SLOW_S


class CreepBound(NamedTuple):
    """95 % bounds, m.

    Attributes:
        max_zernike: of the largest coefficient error beyond tilt.
        rms: of the rms sag error, piston and tilt removed.
        unseen: whether most of `max_zernike` comes from what was held before the mirror was followed.
    """

    max_zernike: float
    rms: float
    unseen: bool = False


class CreepShown(NamedTuple):
    """State of creep when maps showed its effect on the figure.

    Attributes:
        time: s.
        crept: (N, J) states of the creep elements then.
        sigma: (J,) `crept_sigma` then, see :class:`~dm_common.hysteresis.model.HysteresisState`.
        share: share of the slow creep until then that the figure includes since.
        change: m, largest coefficient by which the figure may have changed with it; infinite = not known.
    """

    time: float
    crept: Floats
    sigma: Floats
    share: float
    change: float = np.inf


class CreepError:
    """Errors by creep of one mirror under one law.

    Args:
        law: of N actuators.
        zernike: (K - 3, N) m per unit effective signal, coefficients beyond tilt.
        sag_root: (N, N) m; the norm of its product with effective signals is their rms sag.
        whole: (N,) effective signals of a shape of the whole range.
        shown: creep that check maps have shown; None = the figure is that of the calibration.
    """

    def __init__(
        self, law: HysteresisModel, zernike: Floats, sag_root: Floats, whole: Floats, shown: CreepShown | None = None
    ) -> None:
        self._law = law
        covariance = law.creep_covariance if law.creep_covariance.size else _default_covariance(law)
        size, axes = np.linalg.eigh(covariance[0])
        root = axes * np.sqrt(np.maximum(size, 0.0))
        self._each = covariance[1]
        rows = np.vstack((zernike, sag_root))
        self._rows, self._coefficients, self._root = rows, len(zernike), root
        self._before = law.crept[:, None] if law.crept.shape == whole.shape else np.zeros((len(whole), 1))
        self._shown = shown or CreepShown(0.0, self._before, np.zeros(len(law.creep_time)), 0.0)
        self._share = self._shown.share * (law.creep_time > SLOW_S)
        # Effect of a shape of the whole range held unobserved, by element.
        share = np.atleast_2d(law.creep_share).mean(axis=0)
        share[: len(law.lag_time)] += np.atleast_2d(law.lag_share).mean(axis=0)  # of elements that follow the signals
        self._unseen = (rows @ whole)[:, None] * share
        # What was held unobserved cannot have left more than maps show: the figure changed by their share of it.
        effect = float(np.abs(self._unseen[: len(zernike)] @ (self._share * self._shown.sigma)).max())
        self._left = min(1.0, self._shown.change / effect) if effect > 0.0 else 1.0
        # What was held before the calibration fades for hours. A run of minutes shows its size, but hardly which
        # actuators it is in: each may deviate from what was found by a share of the rms over all.
        found = float(np.sqrt(np.mean(np.square(law.crept)))) if law.crept.size else 0.0
        self._old = UNKNOWN_SHARE * found * share

    def bound(
        self, state: HysteresisState, position: Floats, ahead: float, measured: float | None = None
    ) -> CreepBound:
        """Bound of a move from `state` to static effective signals `position` (N,), `ahead` s after it and at AGES.

        The largest of these, since a held shape is corrected by the same law.

        Args:
            measured: s, when the same shape was measured at ages within MEASURED_S on a mirror degaussed before (a
                recipe): only the difference from then counts. 0 = not known, so in the run of the calibration.
        """
        ages = np.array([ahead, *(age for age in AGES if age > ahead)])
        faded = np.exp(-ages[:, None] / self._law.creep_time)  # (T, J)
        followed = position[:, None] + (state.crept - position[:, None]) * faded[:, None]
        # Figure and recipes include the old creep of when they were measured, and what maps have shown since.
        time, shown = self._law.creep_time, self._shown
        begin = max((measured or 0.0) - self._law.crept_at, IN_FIGURE_S)
        included = self._before * np.exp(-begin / time)
        if measured is None or measured < shown.time:
            included = included + self._share * (shown.crept - included)
        features = np.concatenate(
            (np.broadcast_to(position[:, None], (*followed.shape[:2], 1)), followed - included), axis=2
        )
        if measured is not None:
            then = np.exp(-np.clip(ages, *MEASURED_S)[:, None] / time)[:, None]
            features[:, :, 0] = 0.0
            features[:, :, 1:] = followed - position[:, None] * (1.0 - then) - included * then
        shared = np.square(self._rows @ (features @ self._root)).sum(axis=2)  # (T, K - 3 + N)
        # One unobserved shape that all elements have followed, shown by maps in part; and what was held since.
        same = np.minimum(shown.sigma * np.exp(-np.maximum(state.time - shown.time, 0.0) / time), state.crept_sigma)
        since = np.sqrt(np.square(state.crept_sigma) - np.square(same))
        figure = self._share * shown.sigma  # maps shift recipes as they shift the figure
        unseen = np.square(self._left * (same * faded - figure) @ self._unseen.T)
        unseen += np.square((since * faded) @ self._unseen.T)
        shared += unseen
        each = np.einsum("tnj,jk,tnk->tn", features, self._each, features, optimize=True)
        # Old creep counts from when the figure holds, or from when the recipe was measured, if that was later.
        at = np.array([*(state.time + ages), shown.time]) - self._law.crept_at
        at = np.maximum(at, 0.0 if measured is None else begin)
        fade = np.exp(-at[:, None] / time) - np.exp(-begin / time)
        each += np.square((fade[:-1] - self._share * fade[-1]) @ self._old)[:, None]
        each = each @ np.square(self._rows).T
        count = self._coefficients
        largest = SIGMAS_95**2 * shared[:, :count].max(axis=1) + LARGEST_95**2 * each[:, :count].max(axis=1)
        rms = (shared + each)[:, count:].sum(axis=1)
        worst = int(largest.argmax())
        most = bool(SIGMAS_95**2 * unseen[worst, :count].max() > 0.5 * largest[worst])
        return CreepBound(float(np.sqrt(largest[worst])), SIGMAS_95 * float(np.sqrt(rms.max())), most)

    def drift(self, moved: HysteresisState, effective: Floats) -> tuple[float, float]:
        """Largest coefficient and rms sag, m, over AGES, of the creep of a shape that nothing corrects.

        It should be at `effective` (N,); the mirror has just moved to the state `moved`.
        """
        law = self._law
        gaps = [law.effective(law.advance(moved, moved.time + age)) - effective for age in AGES]
        errors, count = self._rows @ np.transpose(gaps), self._coefficients
        return float(np.abs(errors[:count]).max()), float(np.linalg.norm(errors[count:], axis=0).max())


def _default_covariance(law: HysteresisModel) -> Floats:
    """Covariances if the calibration has none; its gains include the creep of fast elements."""
    time = law.creep_time
    share = UNKNOWN_SHARE * np.atleast_2d(law.creep_share).mean(axis=0)
    rows = np.hstack((np.where(time < UNKNOWN_BELOW, -1.0, 0.0)[:, None], np.eye(len(time))))
    rows *= np.where((time < UNKNOWN_BELOW) | (time > UNKNOWN_ABOVE), share, 0.0)[:, None]
    return np.stack((rows.T @ rows, np.zeros((1 + len(time),) * 2)))
