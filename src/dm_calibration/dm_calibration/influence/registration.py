"""Pose of the mirror in the maps: turn, mirror image, shift, scale and numbering, in one estimate from its pokes.

A poke raises a broad bump over its actuator. Each bump is located by itself. The bumps are assigned one to one to the
configured places (Hungarian method), alternating with the fit of a similarity (iterative closest point), from start
angles around the full circle; the best similarity is refined on the maps themselves, with the shape of the bumps: that
of a plate on actuators, or of a membrane or bimorph held at its edge, whichever fits better.

A regular arrangement looks the same after some turns: a turned mirror then cannot be distinguished from one whose
numbering begins elsewhere. Of the descriptions that fit equally well, the one is taken that leaves most actuators where
they are configured; among several of these, the one nearest to the configuration.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from dm_calibration.influence.bumps import Bump, Places, bumps
from dm_common import Bools, Floats, Ints
from dm_common.geometry import pitch
from dm_common.optics.sampling import SamplePoints

#: Widths tried for the expected bumps (standard deviation, in pitches); a stiffer plate answers more broadly.
WIDTHS = (0.5, 0.7, 0.9, 1.15, 1.5)
#: Radius, in those of the aperture, at which the search for the edge of a membrane begins if actuators lie inside it.
EDGE_START = 1.4
#: A search that ends with the edge nearer to the outermost actuator than this share of the width has found no edge.
EDGE_GAP = 0.02
#: Bumps are looked for up to this distance from the centre of the aperture, in its radii, ...
REACH = 1.45
#: ... on a grid of this spacing, in pitches, but no finer than this, in radii, so that two configured places that are
#: too close by mistake do not make it fill the memory.
GRID, FINEST = 0.25, 0.02
#: Angles around the full circle at which the search starts, for each image and scale.
STARTS = 36
#: Number of central places over which the innermost bump may lie: one and its neighbours.
ANCHORS = 7
#: Number of best starts that are followed: a hexagonal arrangement looks the same in twelve positions.
TRIED = 36
ROUNDS = 20
#: A bump further than this from every configured place, in pitches, belongs to none.
TOLERANCE = 0.7
#: Bumps nearer to each other than this, in pitches, belong to one place.
TOGETHER = 0.5
#: Fewest places that distinguish a turn from a mirror image.
PLACES_MIN = 3
#: Descriptions whose mean square distances differ by less than this, in square pitches, fit alike.
ALIKE = 0.02
#: Of those, a smaller turn is preferred even if up to this share of the actuators more is then out of place.
SHARE = 0.25
#: Actuators nearer to the centroid than this share of the outermost are used for the refinement: those at the rim
#: respond differently, since the plate ends there.
INNER = 0.72
INNER_MIN = 6
#: Relative errors of scale and shift due to bumps of another shape than expected.
SCALE_BIAS = 0.005
#: The same for scale if maps consist of terms only, which may have been fitted over a larger aperture.
SCALE_BIAS_OF_TERMS = 0.02
SHIFT_BIAS = 0.02


@dataclass(frozen=True)
class Registration:
    """Pose of the mirror in the maps, relative to the configuration.

    An actuator configured at p is seen at ``scale * turn(turn, image(p)) + shift``; the image exchanges left and right.

    Attributes:
        turn: counter-clockwise, rad, -pi to pi.
        mirrored: whether the maps show the mirror image.
        shift: (2,) x and y of the mirror's origin from the centre of the aperture, m.
        scale: distances seen / configured.
        turn_sigma, shift_sigma, scale_sigma: standard errors, in the same units.
        bump: shape of the surface over an actuator, m.
    """

    turn: float
    mirrored: bool
    shift: tuple[float, float]
    scale: float
    turn_sigma: float
    shift_sigma: float
    scale_sigma: float
    bump: Bump

    def seen(self, x: Floats, y: Floats) -> Places:
        """Where actuators configured at `x`, `y` (m) are seen, m from the centre of the aperture."""
        return _seen(_Similarity(self.scale * np.exp(1j * self.turn), complex(*self.shift), self.mirrored), x + 1j * y)


class _Similarity(NamedTuple):
    factor: complex
    shift: complex
    mirrored: bool


class _Match(NamedTuple):
    """A similarity, the place (A,) that it gives each bump, the mean square distance of bumps from their places (in
    square pitches), and which bumps (A,) lie at their places.
    """

    similarity: _Similarity
    place: Ints
    distance: float
    placed: Bools


def _seen(similarity: _Similarity, places: Places) -> Places:
    return similarity.factor * (-places.conj() if similarity.mirrored else places) + similarity.shift


def register(
    unit: Floats, active: Ints, points: SamplePoints, x: Floats, y: Floats, radius: float, terms: Floats | None
) -> Registration | None:
    """Find the pose of the mirror in the maps: the best fit, however bad it is; None if all responses lie over one or
    two places.

    Args:
        unit: (A, P) responses of the `active` actuators, of unit rms, piston and tilt removed.
        active: (A,) their indices, at least 3.
        points: the sampling points, of the unit disc.
        x, y: (N,) configured positions, m.
        radius: of the aperture, m.
        terms: as returned by :func:`only_terms`.
    """
    places: Places = np.asarray((x + 1j * y) / radius, dtype=np.complex128)
    step = pitch(places.real, places.imag)
    seen, width = _located(unit, points, step, terms)
    if np.unique((np.abs(seen[:, None] - seen) < TOGETHER * step).argmax(axis=1)).size < PLACES_MIN:
        return None
    match = _matched(seen, active, places, step)
    return _refined(match, unit, points, places, width, radius, terms)


def _located(unit: Floats, points: SamplePoints, step: float, terms: Floats | None) -> tuple[Places, float]:
    """Where each response (A, P) looks most like a bump, and the width that fits best in all."""
    spacing = max(step * GRID, FINEST)
    line = np.arange(-REACH, REACH + spacing, spacing)
    grid = (line[:, None] + 1j * line).ravel()
    grid = grid[np.abs(grid) <= REACH]
    tables = [np.abs((unit * points.weight) @ bumps(grid, Bump(width * step), points, terms)[0].T) for width in WIDTHS]
    best = int(np.argmax([table.max(axis=1).mean() for table in tables]))
    return grid[tables[best].argmax(axis=1)], WIDTHS[best] * step


def _matched(seen: Places, active: Ints, places: Places, step: float) -> _Match:
    """The similarity and numbering that take the configured `places` to those `seen`."""
    spread = float(np.std(seen) / np.std(places))
    starts = [
        start
        for mirrored in (False, True)
        for size in {1.0, round(spread, 2)}
        for angle in np.arange(STARTS) * 2 * np.pi / STARTS
        for start in _over_each_other(seen, places, size * np.exp(1j * angle), mirrored)
    ]
    nearest = [np.abs(_seen(start, places)[:, None] - seen).min(axis=0) / step for start in starts]
    order = np.argsort([np.mean(np.minimum(distance, TOLERANCE) ** 2) for distance in nearest], kind="stable")
    # A few bumps fit many turns, so the configured position is always tried.
    own = _Similarity(1.0 + 0j, complex((seen - places[active]).mean()), False)
    matches = [_closest(seen, places, start, step) for start in (own, *(starts[index] for index in order[:TRIED]))]
    least = min(match.distance for match in matches)
    alike = [match for match in matches if match.distance < least + ALIKE]
    moved = [int((match.place != active).sum()) for match in alike]
    within = min(moved) + SHARE * len(seen)
    near = [match for match, count in zip(alike, moved, strict=True) if count <= within]
    return min(near, key=lambda match: (match.similarity.mirrored, round(abs(np.angle(match.similarity.factor)), 3)))


def _over_each_other(seen: Places, places: Places, factor: complex, mirrored: bool) -> list[_Similarity]:
    """The similarities with this `factor` that superpose the centroids, and, if actuators are missing so that the
    centroids differ, those that put the innermost bump over one of the central places.
    """
    images = _seen(_Similarity(factor, 0j, mirrored), places)
    shifts = [seen.mean() - images.mean()]
    if len(seen) < len(places):
        innermost = seen[np.abs(seen - seen.mean()).argmin()]
        shifts += list(innermost - images[np.argsort(np.abs(places - places.mean()), kind="stable")[:ANCHORS]])
    return [_Similarity(factor, complex(shift), mirrored) for shift in shifts]


def _closest(seen: Places, places: Places, start: _Similarity, step: float) -> _Match:
    """Iterative closest point from `start`."""
    image = -places.conj() if start.mirrored else places
    factor, shift = start.factor, start.shift
    before = np.full(seen.size, -1)
    for _ in range(ROUNDS):
        distance = np.abs(seen[:, None] - factor * image - shift) / step
        place = linear_sum_assignment(np.minimum(distance, TOLERANCE) ** 2)[1]
        own = distance[np.arange(seen.size), place]
        placed = own < TOLERANCE
        if (place == before).all() or placed.sum() < 3:
            break
        before = place
        design = np.column_stack((image[place[placed]], np.ones(placed.sum())))
        factor, shift = (complex(value) for value in np.linalg.lstsq(design, seen[placed], rcond=None)[0])
    similarity = _Similarity(factor, shift, start.mirrored)
    return _Match(similarity, place, float(np.mean(np.minimum(own, TOLERANCE) ** 2)), placed)


def _refined(
    match: _Match, unit: Floats, points: SamplePoints, places: Places, width: float, radius: float, terms: Floats | None
) -> Registration:
    """Fit similarity and shape to the maps of actuators inside the aperture, if possible away from the rim (INNER)."""
    away = np.abs(places - places.mean())[match.place]
    inside = match.placed & (np.abs(_seen(match.similarity, places)[match.place]) < 1.0)
    inner = inside & (away <= INNER * np.abs(places - places.mean()).max())
    use = next((some for some in (inner, inside) if some.sum() >= INNER_MIN), match.placed).copy()
    if not use.any():  # no response lies where a configured position could be
        use[:] = True
    mirrored, root = match.similarity.mirrored, np.sqrt(points.weight)

    def described(values: Floats) -> tuple[Places, Bump]:
        factor = np.exp(values[0] + 1j * values[1])
        seen = _seen(_Similarity(factor, complex(values[2], values[3]), mirrored), places)
        outermost = max(1.0, float(np.abs(seen).max()))  # the edge is beyond all actuators and the aperture
        return seen, Bump(np.exp(values[4]), *(outermost + np.exp(values[5:])))

    def residual(values: Floats, chosen: Bools) -> Floats:
        seen, bump = described(values)
        expected, _ = bumps(seen[match.place[chosen]], bump, points, terms)
        measured = unit[chosen]
        share = (measured * expected) @ points.weight  # the expected bumps are of unit rms
        return np.asarray(root * (measured - share[:, None] * expected))

    logarithm, shift = np.log(match.similarity.factor), match.similarity.shift
    plate = np.array([logarithm.real, logarithm.imag, shift.real, shift.imag, np.log(width)])
    starts = (plate, np.append(plate, np.log(EDGE_START - 1.0)))
    fits = [least_squares(lambda values: residual(values, use).ravel(), start) for start in starts]
    sound = (fit for fit in fits if (fit.x[5:] - fit.x[4] > np.log(EDGE_GAP)).all())
    # One more unknown always leaves a little less; of bumps that lean to the middle it leaves at most half.
    fitted = min(sound, key=lambda fit: float(fit.cost) * (2.0 if fit.x.size > plate.size else 1.0))
    left = np.linalg.norm(fitted.fun.reshape(-1, len(points)), axis=1)
    good = left <= 3.0 * np.median(left)
    if not good.all() and good.sum() >= 3:  # again without those that respond differently
        use[np.flatnonzero(use)[~good]] = False
        fitted = least_squares(lambda values: residual(values, use).ravel(), fitted.x)
    sigma = _standard_errors(fitted.jac.reshape(-1, len(points), fitted.x.size), fitted.fun.reshape(-1, len(points)))
    values, scale = fitted.x, float(np.exp(fitted.x[0]))
    metres = (float(values[2] * radius), float(values[3] * radius))
    return Registration(
        turn=float(np.angle(np.exp(1j * values[1]))),
        mirrored=mirrored,
        shift=metres,
        scale=scale,
        turn_sigma=float(sigma[1]),
        shift_sigma=float(np.hypot(max(sigma[2], sigma[3]) * radius, SHIFT_BIAS * np.hypot(*metres))),
        scale_sigma=float(np.hypot(sigma[0], SCALE_BIAS if terms is None else SCALE_BIAS_OF_TERMS) * scale),
        bump=Bump(*map(float, described(values)[1].scaled(radius))),
    )


def _standard_errors(jacobian: Floats, residual: Floats) -> Floats:
    """(K,) standard errors, from the scatter between the A actuators: jacobian (A, P, K), residual (A, P).

    Neighbouring points of a response have similar errors, so each actuator counts as one observation.
    """
    count, _, unknowns = jacobian.shape
    hessian = np.einsum("apk,apl->kl", jacobian, jacobian)
    gradient = np.einsum("apk,ap->ak", jacobian, residual)
    inverse = np.linalg.pinv(hessian)
    covariance = inverse @ (gradient.T @ gradient) @ inverse * count / max(count - 0.4 * unknowns, 1.0)
    return np.sqrt(np.diag(covariance))
