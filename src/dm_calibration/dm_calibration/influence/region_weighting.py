"""AZWreg: region weights of a set of maps, their epsilon by cross-validation, and the coefficients they give.

See :mod:`~dm_calibration.influence.weights` for where weights act; this is its place (a).

Epsilon. In [1] it is a prior parameter. As epsilon goes from 0 to infinity the weights go from w_i ~ 1/r_i (the common
factor does not matter) to 1, so some candidates around the median of the r_i cover both limits. The chosen one is that
whose influence function best predicts maps it has not seen, by the measure of [1]: the rms surface error inside the ten
concentric regions, each with the same weight. The figure at rest, which no weights can change, is part of the
prediction. Weights for a fold come from the other folds alone. If no weights predict better than equal ones, the
largest epsilon among the best candidates is chosen and the result says so; a prior epsilon can be given instead.
"""

from dataclasses import dataclass

import numpy as np

from dm_calibration.influence import quality
from dm_calibration.influence.maps import MapSet, StepKind
from dm_calibration.influence.regression import Design, TooFewMapsError, make_design, regress
from dm_calibration.influence.weights import coefficient_operator, region_weights, surface_control_error
from dm_common import Bools, Floats
from dm_common.optics.piston_tilt import remove_piston_tilt, weighted_fit
from dm_common.optics.sample_regions import AREA_FRACTIONS, regional_rms
from dm_common.optics.zernike import PISTON_TILT, TERMS, basis

#: Candidates of epsilon, in medians of the region variances.
EPSILON_CANDIDATES: tuple[float, ...] = tuple(10.0 ** (k / 3.0) for k in range(-6, 7))
#: Standard deviation of regional errors, relative to their mean, below which they count as constant over the surfaces.
CONSTANT = 1e-9
#: Fewest sample surfaces: if a fold of two is left out, two must remain for a variance.
SURFACES_MIN = 4


@dataclass(frozen=True, eq=False)
class RegionWeighting:
    """Weights of the ten regions and their derivation.

    Attributes:
        variance: (R,) r_i, m^2.
        epsilon: m^2.
        weights: (R,) Eq. (8).
        prior: whether epsilon was given rather than chosen.
        candidates: (E,) m^2, the values of epsilon tried, rising.
        score: (E,) m, held-out rms surface error of each, mean square over maps and regions.
        score_unweighted: m, the same with all weights 1.
        surfaces: number of surfaces that the variances are taken over.
    """

    variance: Floats
    epsilon: float
    weights: Floats
    prior: bool
    candidates: Floats
    score: Floats
    score_unweighted: float
    surfaces: int
    folds: int

    @property
    def helps(self) -> bool:
        """Whether some candidate predicts unseen maps better than equal weights."""
        return bool(self.score.min() < self.score_unweighted)

    def sentence(self) -> str:
        """What a user of the influence function must know."""
        origin = "given" if self.prior else f"by {self.folds}-fold cross-validation"
        verdict = "" if self.helps else "; no weights predict unseen maps better than equal ones"
        return (
            f"AZWreg: coefficients fitted to the sag with region weights {', '.join(f'{w:.2f}' for w in self.weights)} "
            f"from the centre outwards (Eq. 8, epsilon {self.epsilon * 1e18:.3g} nm^2 {origin}, {self.surfaces} "
            f"surfaces; held-out regional error at best {self.score.min() * 1e9:.2f} nm, with equal weights "
            f"{self.score_unweighted * 1e9:.2f} nm{verdict})."
        )


def sample_surfaces(maps: MapSet) -> Bools:
    """(M,) maps over which the region variances are taken: the surfaces of Table 1, else all but reference frames."""
    chosen = np.array([kind == StepKind.SURFACE for kind in maps.kind], dtype=bool)
    return chosen if np.unique(maps.step[chosen]).size >= SURFACES_MIN else ~maps.reference


def choose_weighting(
    design: Design, maps: MapSet, sag: Floats, folds: int = 10, epsilon: float | None = None
) -> RegionWeighting:
    """Region weights of `maps` with epsilon by k-fold cross-validation, or with a given one.

    Args:
        design: of these maps, (M, p).
        sag: (M, P) m, without gaps, piston and tilt removed.
        folds: at least 2.
        epsilon: m^2, used instead of the one that cross-validation prefers; `score` is computed nevertheless.

    Raises:
        TooFewMapsError: fewer than four sample surfaces.
        EmptyRegionError: a sample surface has no data in some region.
        ValueError: regional errors that are the same for all surfaces, so that no weights follow; epsilon not above
            0; maps with other than 21 terms.
    """
    if maps.terms != len(TERMS):
        raise ValueError(f"the maps carry {maps.terms} terms: AZWreg fits {len(TERMS)}; use AZreg")
    chosen = sample_surfaces(maps)
    # The gaps of `sag` were filled from a fit: a region without data would get its weight from filled values.
    regional_rms(maps.sag[chosen], maps.points, labels=maps.select(chosen).label)
    states = np.unique(maps.step[chosen]).size
    if states < SURFACES_MIN:
        raise TooFewMapsError(
            f"{states} sample surfaces: the region weights of AZWreg come from variances over surfaces and need "
            f"at least {SURFACES_MIN}; measure more surfaces or use AZreg"
        )
    fold = quality.folds_of(maps.step, chosen, folds)
    fractions = np.array((0.0, *EPSILON_CANDIDATES))  # 0 stands for no weights at all
    variance = _variance(design, maps, sag, chosen)
    scale = float(np.median(variance))
    held_out, tested = quality.held_out_residual(design, sag, fold)
    predicted = sag - held_out
    tested = tested if tested.any() else chosen
    squares = np.zeros(fractions.size)
    modes = basis(maps.points.x, maps.points.y)
    for k in range(int(fold.max()) + 1):
        left_out = fold == k
        judged = left_out & tested
        if not judged.any():
            continue
        train = Design(design.matrix[~left_out], design.drift, design.excited)
        r = _variance(train, maps.select(~left_out), sag[~left_out], chosen[~left_out])
        for e, share in enumerate(fractions):
            weights = region_weights(r, share * scale) if share else np.ones(len(AREA_FRACTIONS))
            terms = predicted[judged] @ coefficient_operator(maps.points, weights).T
            error = remove_piston_tilt(sag[judged] - terms @ modes.T, maps.points)
            squares[e] += np.square(regional_rms(error, maps.points)).sum()
    score = np.sqrt(squares / (len(AREA_FRACTIONS) * max(int((tested & chosen).sum()), 1)))
    candidates = fractions[1:] * scale
    mildest_best = float(candidates[::-1][np.argmin(score[1:][::-1])])
    chosen_epsilon = mildest_best if epsilon is None else epsilon
    return RegionWeighting(
        variance=variance,
        epsilon=chosen_epsilon,
        weights=region_weights(variance, chosen_epsilon),
        prior=epsilon is not None,
        candidates=candidates,
        score=score[1:],
        score_unweighted=float(score[0]),
        surfaces=states,
        folds=int(fold.max()) + 1,
    )


def weighting_of(maps: MapSet, used: Bools, folds: int = 10, epsilon: float | None = None) -> RegionWeighting:
    """Region weights of the maps of a calibration, for a command solve or a report; see :func:`choose_weighting`.

    Args:
        used: (M,) which maps entered the fit.

    Raises:
        TooFewMapsError: the maps do not determine the influence function, or fewer than four sample surfaces.
        EmptyRegionError, ValueError: as :func:`choose_weighting`.
    """
    good = maps.select(used)
    design = make_design(good)
    _, responses = regress(design, good)
    return choose_weighting(design, good, responses[:, maps.terms :], folds, epsilon)


def weighted_coefficients(maps: MapSet, sag: Floats, weights: Floats) -> Floats:
    """(M, 21) coefficients fitted to the sag with region weights, m; piston and tilt as measured.

    Args:
        sag: (M, P) m, without gaps, piston and tilt removed.
        weights: (R,) of the regions.
    """
    coefficients = sag @ coefficient_operator(maps.points, weights).T
    # The plane that was removed from the sag is fitted exactly with any weights.
    plane = basis(maps.points.x, maps.points.y)[:, :PISTON_TILT]
    coefficients[:, :PISTON_TILT] += weighted_fit(maps.sag - sag, plane, maps.points.weight)
    return np.asarray(coefficients)


def _variance(design: Design, maps: MapSet, sag: Floats, chosen: Bools) -> Floats:
    """(R,) variance over the chosen maps of the regional rms surface control error, G being that of AZreg."""
    coefficients = np.linalg.pinv(design.matrix, rcond=1e-9) @ maps.coefficients
    influence = np.zeros((maps.terms, maps.actuators))
    influence[:, design.excited] = coefficients[design.drift :].T
    error = surface_control_error(sag[chosen], maps.applied[chosen], influence, maps.points)
    regional = regional_rms(error, maps.points, labels=maps.select(chosen).label)
    variance = regional.var(axis=0, ddof=1)
    if (np.sqrt(variance) <= CONSTANT * regional.mean(axis=0)).all():
        raise ValueError(
            f"the regional errors are the same for all {chosen.sum()} sample surfaces, so Eq. (8) has no variances to "
            "weight by: measure surfaces that differ, or use AZreg"
        )
    return np.asarray(variance)
