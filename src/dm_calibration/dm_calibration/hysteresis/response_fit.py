"""The law of a mirror from any linear measurement of it: sag, Zernike coefficients, slopes of a wavefront sensor.

Records of other laboratories and of other kinds of mirrors need neither ROS nor map files: commands, measurements and
times suffice to find which law predicts best, and by how much.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dm_calibration.hysteresis.candidate_fit import CANDIDATES, Candidate
from dm_calibration.hysteresis.features import follow
from dm_calibration.hysteresis.identify import identify
from dm_calibration.hysteresis.responses import Responses, agreeing
from dm_calibration.hysteresis.run import Run, basis_of, start_of, without
from dm_common import Bools, Floats
from dm_common.hysteresis.model import HysteresisModel
from dm_common.mirror import actuators_text

#: Laws that are compared: those of a calibration, and a quadratic one between the linear and the cubic.
LAWS = (CANDIDATES[0], Candidate("squares", 0, 2, 0), *CANDIDATES[1:])
#: Size to which all measurements are scaled, m: typical of a deformation, as the thresholds of the fit assume.
_SIZE = 1e-6
#: Largest absolute time, s: stamps of maps are int64 numbers of ns.
TIME_MAX_S = 9e9
#: Tolerance between `moved` and the times of the maps, s: present Unix times are rounded as floats.
_ROUNDED_S = 1e-6
#: Contiguous blocks of rows in each part that is left out.
_BLOCKS = 5


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """Result for the mirror of one record. D is the number of values of one measurement, in their own unit.

    Attributes:
        name: class of the law that predicts best; of nearly equal ones, the simplest.
        law: of the actuators, from the whole record.
        influence: (N, D) change for a unit of each effective signal.
        figure: (D,) measurement at effective signals 0, averaged over the record.
        drift: (D,) change of the figure from the first measurement to the last.
        held_out: error of each law on parts of the record that it was not fitted to, relative to the signal: rms over
            all numbers, divided by their standard deviation over the record.
        measurements: number of rows used.
        remark: sentences that name rows that contradict every law, actuators that moved too little to show their own
            law, and commands that may be normalised otherwise than to -1..+1; "" = none.
    """

    name: str
    law: HysteresisModel
    influence: Floats
    figure: Floats
    drift: Floats
    held_out: dict[str, float]
    measurements: int
    remark: str = ""

    def predict(self, commands: ArrayLike, times: ArrayLike | None = None, moved: ArrayLike | None = None) -> Floats:
        """(M, D) measurements predicted for `commands` (M, N) at `times` (M,) s, from a degauss or from rest.

        Raises ValueError as :func:`identify_response` does for commands, times and `moved`.
        """
        signals = _signals(commands, len(self.influence))
        seconds, shapes = _seconds(times, moved, len(signals))
        rested = self.law.demagnetised(signals.shape[1], start_of(shapes))
        effective, _ = follow(self.law, rested, signals, seconds, shapes)
        return np.asarray(self.figure + effective @ self.influence)

    def __str__(self) -> str:
        """The laws side by side, the best marked; with the remarks, if any."""
        width = max(len(name) for name in self.held_out)
        rows = [f"{'law':<{width}}  held-out error, % of the signal ({self.measurements} measurements)"]
        rows += [
            f"{name:<{width}}  {100 * error:.2f}{' <' * (name == self.name)}" for name, error in self.held_out.items()
        ]
        return "\n".join((*rows, *filter(None, (self.remark,))))

    __repr__ = __str__


def identify_response(
    commands: ArrayLike,
    measured: ArrayLike,
    times: ArrayLike | None = None,
    *,
    moved: ArrayLike | None = None,
    candidates: Sequence[Candidate] = LAWS,
) -> ResponseFit:
    """Fit each law to parts of a record and compare the predictions for the other parts.

    Parameters
    ----------
    commands : array_like (M, N)
        Signals applied to the mirror, normalised to -1..+1, in order: some hundred random ones, from a degauss or, if
        there is no hysteresis, from any state.
    measured : array_like (M, D)
        Measurements of equal uncertainty that are linear in the surface: sag or slopes at points, coefficients. First
        subtract effects other than the mirror's, such as tilt that changes from map to map. Rows with NaN or
        masked values are ignored.
    times : array_like (M,), optional
        Times of the measurements, s; needed for creep and drift. By default one second apart.
    moved : array_like (M,), optional
        When the mirror took each shape, on the clock of ``times``; by default right after the measurement before.
    candidates
        Laws to compare, as for :func:`~dm_calibration.hysteresis.identify.identify`.

    Raises
    ------
    ExcitationError
        Too few measurements, or more than a tenth of the actuators, and more than one, that hardly move or turn.
    ValueError
        Arrays that do not fit together, measurements that have no complete row or never change, actuators that always
        have the same commands, or times that run backwards or are not in s.
    """
    signals, values = _signals(commands), numbers(measured, "measured")
    if values.ndim != 2 or len(values) != len(signals):
        raise ValueError(f"measured has the shape {values.shape}: must be ({len(signals)}, values per measurement)")
    seconds, shapes = _seconds(times, moved, len(signals))
    if not np.ptp(seconds) > 0.0:
        raise ValueError("times: all are the same; leave them out where they are not known")
    usable: Bools = np.asarray(np.isfinite(values).all(axis=1))
    if not usable.any():
        raise ValueError(
            "measured: every row holds NaN, infinity or masked values; leave out the columns with most of them"
        )
    with np.errstate(over="ignore"):
        size = float(values[usable].std(axis=0).max())
    if not size > 0.0:
        raise ValueError("measured: all rows are equal, must change with the commands")
    if not size < np.inf:
        raise ValueError(f"measured reaches {np.abs(values[usable]).max():g}: too large to compute with")
    if not candidates or candidates[0].own:
        raise ValueError("candidates: must be at least one law, the first of them common to all actuators")
    _check_apart(signals)
    brought = np.where(usable[:, None], values, 0.0) * (_SIZE / size)
    patterns = _patterns(signals[usable], brought[usable])
    seen = brought @ patterns
    run = Run(signals, seconds, Responses(seen, seen.shape[1], usable), start_of(shapes), shapes)
    found = identify(run, candidates=candidates, blocks=_BLOCKS, slope_min=-np.inf)
    fitted = basis_of(np.hstack((run.figure, signals))[usable])
    elsewhere = np.zeros_like(brought)
    elsewhere[usable] = without((brought - seen @ patterns.T)[usable], fitted)
    count, columns = fitted.shape
    # Mean square beside the patterns in a row that is left out, from the residuals of a fit that includes it.
    noise = np.square(elsewhere).sum() / (count - columns) * count / (count - columns)
    error = np.nanmean(np.square(found.held_out), axis=0).sum()
    signal = brought[usable].var(axis=0).sum()
    law = found.fit.law
    middle = seconds - seconds.mean()
    design = np.column_stack((np.ones(len(signals)), middle / np.ptp(middle), run.follow(law)))
    solution = np.linalg.lstsq(design[usable], values[usable], rcond=1e-10)[0]
    remarks = [found.quiet_remark] if found.quiet else []
    if (odd := usable & ~agreeing(usable, np.hstack((found.closest, elsewhere)))).any():
        rows = ", ".join(map(str, np.flatnonzero(odd) + 1))
        remarks.append(f"Rows that no law explains: {rows}. Measurements that failed or were lost must be rows of NaN.")
    if law.has_history and signals.min() >= 0.0:
        remarks.append(
            "The commands are never negative: hysteresis needs them as -1 to +1, with 0 where a degauss ends."
        )
    return ResponseFit(
        name=found.fit.candidate.name,
        law=law,
        influence=solution[2:],
        figure=solution[0],
        drift=solution[1],
        held_out={name: float(np.sqrt((error * score**2 + noise) / signal)) for name, score in found.scores.items()},
        measurements=int(usable.sum()),
        remark="\n".join(remarks),
    )


def _patterns(signals: Floats, values: Floats) -> Floats:
    """(D, P) orthonormal patterns of the responses of `values` (M, D) to `signals` (M, N) and their squares.

    N actuators make at most N; elsewhere is only noise, which would hide the differences between laws.
    """
    powers = np.hstack((np.ones((len(signals), 1)), signals, np.square(signals)))
    response = powers[:, 1:] @ np.linalg.lstsq(powers, values, rcond=None)[0][1:]
    return np.asarray(np.linalg.svd(response, full_matrices=False)[2][: signals.shape[1]].T)


def _signals(commands: ArrayLike, actuators: int | None = None) -> Floats:
    signals = numbers(commands, "commands")
    if signals.ndim != 2 or not signals.size or signals.shape[1] != (actuators or signals.shape[1]):
        raise ValueError(f"commands has the shape {signals.shape}: must be (measurements, {actuators or 'actuators'})")
    check_signals(signals)
    return signals


def check_signals(signals: Floats) -> None:
    """Raise ValueError where `signals` (M, N) are not finite or not normalised (volts, for instance)."""
    finite: Bools = np.asarray(np.isfinite(signals).all(axis=1))
    if not finite.all():
        raise ValueError(f"commands: row {_first(~finite)} holds NaN or an infinity")
    if np.abs(signals).max() > 1.0 + 1e-9:
        raise ValueError(f"commands reach {np.abs(signals).max():g}: must be normalised to -1 to 1")


def _check_apart(signals: Floats) -> None:
    """Raise ValueError where actuators that move always have the same commands."""
    moving = np.flatnonzero(np.ptp(signals, axis=0))
    _, group, size = np.unique(signals[:, moving], axis=1, return_inverse=True, return_counts=True)
    together = moving[size[group.ravel()] > 1] + 1
    if together.size:
        which = actuators_text(together)
        raise ValueError(f"commands: do not separate {which}: each must move on its own in some row")


def _seconds(times: ArrayLike | None, moved: ArrayLike | None, count: int) -> tuple[Floats, Floats | None]:
    """Times since the first measurement, (count,) s: of the measurements and, if known, of the moves."""
    seconds = np.arange(count, dtype=np.float64) if times is None else times_of(times, count)
    if moved is None:
        return seconds - seconds[0], None
    return seconds - seconds[0], between(numbers(moved, "moved", "times in s"), seconds) - seconds[0]


def times_of(times: ArrayLike, count: int) -> Floats:
    """`times` as (count,) s. Raises ValueError for another number of them, or what cannot be times in s."""
    seconds = numbers(times, "times", "times in s")
    if seconds.shape != (count,):
        raise ValueError(f"times has the shape {seconds.shape}: must be ({count},), in s")
    if not np.isfinite(seconds).all():
        raise ValueError(f"times: number {_first(~np.isfinite(seconds))} is NaN or infinite")
    if not np.abs(seconds).max() < TIME_MAX_S:
        raise ValueError(f"times go up to {np.abs(seconds).max():g}: must be in s, not ns, up to {TIME_MAX_S:g}")
    return seconds


def numbers(values: ArrayLike, name: str, kind: str = "real numbers") -> Floats:
    """`values` as floats, NaN where masked.

    Raises ValueError for what is no `kind`: dates, complex numbers, text that is no number, rows of unequal length.
    """
    try:
        given: Any = np.ma.asarray(values)
        if given.dtype.kind not in "cmM":  # would lose a part, or the unit
            return np.asarray(given.astype(np.float64).filled(np.nan))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: must be {kind}: {error}") from error
    raise ValueError(f"{name}: must be {kind}, not {given.dtype}")


def between(moved: Floats, taken: Floats) -> Floats:
    """`moved` (M,) s, each clipped to the interval between the measurements before and after it, `taken` (M,) s.

    Raises:
        ValueError: another shape, not finite, or outside these intervals by more than rounding.
    """
    if moved.shape != taken.shape:
        raise ValueError(f"moved has the shape {moved.shape}: must be {taken.shape} times in s")
    before = np.concatenate(([-TIME_MAX_S], taken[:-1]))
    wrong = ~((moved >= before - _ROUNDED_S) & (moved <= taken + _ROUNDED_S))
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(
            f"moved: number {row + 1} is {moved[row] - taken[row]:+g} s from the time of its map: must lie between "
            f"the previous map ({before[row] - taken[row]:+g} s) and its own (0 s)"
        )
    return np.clip(moved, before, taken)


def _first(rows: Bools) -> int:
    """Number of the first of `rows` that is true, from 1."""
    return int(rows.argmax()) + 1
