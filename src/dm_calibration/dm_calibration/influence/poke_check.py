"""Compare wiring and mounting with the configuration, by the response of the surface to each actuator.

The pose of the whole mirror in the maps is found first (:mod:`~dm_calibration.influence.registration`). Differences
that remain belong to single actuators: dead, weak, inverted, exchanged with another, or two on one channel.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from dm_calibration.influence.bumps import bumps, only_terms, unit_responses
from dm_calibration.influence.registration import Registration, register
from dm_common import Bools, Floats, Ints
from dm_common.figures import counted
from dm_common.geometry import pitch, rings
from dm_common.mirror import actuators_text
from dm_common.optics.sampling import SamplePoints
from dm_common.values import check_array

#: Turn (rad), shift (share of the pitch) and relative change of scale that still count as configured.
TURN_MAX = np.radians(1.5)
SHIFT_MAX = 0.1
SCALE_MAX = 0.03
#: A displaced actuator must fit its new place better than its own by this much in correlation.
PLACE_MARGIN = 0.08
#: Correlation assumed between a silent actuator and its own place: it stays there if no other was found there.
OWN_PLACE = 1e-9
#: A response whose correlation with every bump is below this is not that of one actuator.
LIKENESS_MIN = 0.4
#: Least median correlation of the responses with the expected bumps; below it the configured arrangement is wrong.
FIT_MIN = 0.75
#: Two bumps explain a response if one leaves more than the first of these shares of its square, as one of another shape
#: at the rim hardly does, and both leave less than the second of what one leaves, ...
ONE_LEAVES, DOUBLED = 0.05, 0.5
#: ... and the smaller of them is at least this share of the larger.
SECOND_MIN = 0.4
#: An actuator is weak below this share of the median response of its ring, ...
WEAK_SHARE = 0.4
#: ... and of neighbouring rings, until this many respond: half of a ring may be weak, and the centre is alone.
COMPARED_MIN = 11
#: Fewest actuators that must respond, and least share of them; with fewer the pokes are too small.
ANSWERS_MIN = 3
ANSWERS_SHARE = 0.5


@dataclass(frozen=True)
class PokeCheck:
    """Outcome of a poke check.

    Attributes:
        registration: pose of the mirror in the maps; None = not known.
        place: (N,) 0-based index of the configured actuator over whose place actuator i raised the surface.
        turned: whether the mirror is turned, mirrored or shifted, beyond the tolerances.
        findings: sentences; empty = wiring and orientation are as configured.
    """

    registration: Registration | None
    place: Ints
    turned: bool = False
    findings: tuple[str, ...] = ()

    @property
    def pose(self) -> str:
        """Pose of the mirror in the maps, with standard errors."""
        found = self.registration
        if found is None:
            return "orientation of the mirror in the maps not known"
        turn, sigma = np.degrees((found.turn, found.turn_sigma))
        (x, y), error = 1e3 * np.array(found.shift), 1e3 * found.shift_sigma
        return (
            f"turn {turn:+.2f} +- {sigma:.2f} degrees, {'' if found.mirrored else 'not '}mirrored, "
            f"shift {x:+.2f}, {y:+.2f} +- {error:.2f} mm, scale {found.scale:.3f} +- {found.scale_sigma:.3f}"
        )

    @property
    def passed(self) -> bool:
        return not self.findings


def check_pokes(
    response: Floats,
    points: SamplePoints,
    x: Floats,
    y: Floats,
    radius: float,
    *,
    silent: Bools,
    unmoved: Bools,
) -> PokeCheck:
    """Compare measured responses with the configured layout.

    Args:
        response: (P, N) sag for a unit signal of each actuator, m; piston and tilt are ignored.
        points: the sampling points, of the unit disc.
        x, y: (N,) configured positions, m.
        radius: of the aperture, m.
        silent: (N,) actuators without a response above the noise.
        unmoved: (N,) actuators that were not driven, which make no finding.
    """
    count = x.size
    check_array("response", response, (len(points), count), finite=False)
    unit, size = unit_responses(response.T, points)
    quiet = (silent | (size == 0.0)) & ~unmoved
    active = np.flatnonzero(~(quiet | unmoved))
    nothing = PokeCheck(None, np.arange(count))
    quiet_said = findings = _named(quiet, "shows/show no response above the noise")
    if active.size < max(ANSWERS_MIN, ANSWERS_SHARE * (active.size + quiet.sum())):
        problem = (
            f"only {active.size} of {active.size + quiet.sum()} actuators answer above the noise: the pokes are too "
            "small (poke_amplitude), the drive is off, or most channels are those of no actuator (mirror.channels); "
            "wiring and orientation cannot be checked"
            if quiet.any()
            else f"{counted(active.size, 'actuator was', 'actuators were')} moved: a check of wiring and orientation "
            f"needs {ANSWERS_MIN}"
        )
        return replace(nothing, findings=(problem, *findings))
    terms = only_terms(unit[active], points)
    single, double = active, {}
    for _ in range(2):  # again without actuators that move two places, which would distort the pose
        registered = register(unit[single], single, points, x, y, radius, terms)
        if registered is None:
            problem = (
                "all channels move the same one or two places: check the wiring, mirror.pitch (or mirror.actuator_x "
                "and _y), and that the maps are of this mirror"
            )
            return replace(nothing, findings=(*findings, problem))
        registration = registered
        seen, bump = registration.seen(x, y) / radius, registration.bump.scaled(1.0 / radius)
        expected, height = bumps(seen, bump, points, terms)
        height = np.maximum(height, np.finfo(float).tiny)
        table = np.zeros((count, count))
        table[active] = (unit[active] * points.weight) @ expected.T
        double = _doubled(table, (expected * points.weight) @ expected.T, height)
        single = np.setdiff1d(active, list(double))
        if not double or single.size < ANSWERS_MIN:
            break
    place = _places(np.abs(table), active, double)
    found = table[np.arange(count), place]
    if np.median(np.abs(found[active])) < FIT_MIN:
        problem = (
            "the responses do not fit the configured positions however the mirror is turned: check mirror.pitch or "
            "mirror.actuator_x and _y, and that the maps show the whole working aperture of this mirror"
        )
        return replace(nothing, findings=(*findings, problem))
    pose, turned = _pose_findings(registration, pitch(x, y))
    if pose:  # an actuator at the rim may lie outside an aperture that is not centred on the mirror
        quiet_said = [f"{text} in the maps as they are now: check again once they are corrected" for text in quiet_said]
    alone = np.isin(np.arange(count), active) & ~np.isin(np.arange(count), list(double))
    unlike = alone & (np.abs(found) < LIKENESS_MIN)
    # The sign of a response that looks like that of no actuator says nothing of the way in which one moves the surface.
    signs = _sign_findings(np.sign(found) * ~unlike, pushes=np.isinf(registration.bump.edge))
    findings = quiet_said + pose + signs + _place_findings(place)
    for actuator, pair in double.items():
        findings.append(
            f"actuator {actuator + 1} moves the surface at actuators {pair[0] + 1} and {pair[1] + 1} together"
        )
    findings += _named(unlike, "answers/answer in a way that does not look like that of one actuator")
    weak = alone & ~unlike & _weak(size, height[place], rings(x, y)[place], alone)
    findings += _named(weak, f"answers/answer weakly, below {WEAK_SHARE:.0%} of the others of the ring")
    return PokeCheck(registration, place, turned, tuple(findings))


def _pose_findings(found: Registration, step: float) -> tuple[list[str], bool]:
    """Sentences on how `found` differs from the configuration, and whether orientation and aperture correct that."""
    parts = []
    turn, sigma = np.degrees(found.turn), np.degrees(found.turn_sigma)
    if abs(found.turn) > TURN_MAX + 3.0 * found.turn_sigma:
        way = "counter-clockwise" if turn > 0 else "clockwise"
        parts.append(f"turned by {abs(turn):.2f} +- {sigma:.2f} degrees {way}")
    if found.mirrored:
        parts.append("mirrored left to right" + (", then " + parts.pop() if parts else ""))
    if np.hypot(*found.shift) > SHIFT_MAX * step + 3.0 * found.shift_sigma:
        right, up = (1e3 * value for value in found.shift)
        parts.append(f"shifted by {right:+.2f} mm in x and {up:+.2f} mm in y, +- {1e3 * found.shift_sigma:.2f} mm")
    sentences = [f"the maps show the mirror {' and '.join(parts)}"] if parts else []
    if abs(found.scale - 1.0) > SCALE_MAX + 3.0 * found.scale_sigma:
        sentences.append(
            f"the maps show the actuators {found.scale * step * 1e3:.2f} +- {found.scale_sigma * step * 1e3:.2f} mm "
            f"apart, configured are {step * 1e3:.2f} mm: correct the lateral scale of the instrument, or mirror.pitch"
        )
    return sentences, bool(parts)


def _places(table: Floats, active: Ints, double: dict[int, tuple[int, int]]) -> Ints:
    """(N,) the place of each actuator; places other than its own count only where they fit clearly better."""
    table = table.copy()
    for actuator, pair in double.items():  # its own place if that is one of the two, else the first
        table[actuator] = np.arange(len(table)) == (actuator if actuator in pair else pair[0])
    silent = np.setdiff1d(np.arange(len(table)), active)
    table[silent, silent] = OWN_PLACE
    place = np.asarray(linear_sum_assignment(table, maximize=True)[1])
    for cycle in cycles(place):
        members = [actuator for actuator in cycle if actuator in active]
        gain = [table[a, place[a]] - table[a, a] for a in members]
        if not gain or float(np.mean(gain)) < PLACE_MARGIN:
            place[list(cycle)] = list(cycle)
    return place


def _doubled(table: Floats, overlap: Floats, height: Floats) -> dict[int, tuple[int, int]]:
    """Actuators that raise two places at once, with these places.

    Args:
        table: (N, N) correlations of each response with the bumps expected at each place.
        overlap: (N, N) of these bumps with each other.
        height: (N,) rms of each bump as raised by one actuator.
    """
    found: dict[int, tuple[int, int]] = {}
    apart = ~np.eye(len(overlap), dtype=bool)
    determinant = np.where(apart, 1.0 - np.square(overlap), 1.0)
    for actuator, row in enumerate(table):
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # places far beside the aperture
            first = (row[:, None] - overlap * row) / determinant  # [j, k]: of the bump at j if one at k is fitted too
            explained = first * row[:, None] + first.T * row  # by both bumps, as a sum of squares
            rise = first / height[:, None]
            alike = abs(rise) >= SECOND_MIN * abs(rise.T)
            both = (rise * rise.T > 0.0) & alike & alike.T
        explained[~(both & apart)] = 0.0
        best = np.unravel_index(explained.argmax(), explained.shape)
        left = 1.0 - np.square(row).max()
        if explained[best] > 0.0 and left > ONE_LEAVES and 1.0 - explained[best] < DOUBLED * left:
            found[actuator] = (int(min(best)), int(max(best)))
    return found


def _weak(size: Floats, height: Floats, ring: Ints, counted: Bools) -> Bools:
    """Actuators below WEAK_SHARE of their ring, both as measured and relative to the bump expected at their place."""
    weak = counted.copy()
    for number in np.unique(ring[counted]):
        steps = np.abs(ring - number)
        enough = (reach for reach in range(steps.max() + 1) if (counted & (steps <= reach)).sum() >= COMPARED_MIN)
        beside = counted & (steps <= next(enough, steps.max()))
        for response in (size, size / height):
            weak[ring == number] &= response[ring == number] < WEAK_SHARE * np.median(response[beside])
    return weak


def cycles(place: Ints) -> list[tuple[int, ...]]:
    """The cycles of a permutation that are longer than 1, each from its smallest member on."""
    found: list[tuple[int, ...]] = []
    for start in range(place.size):
        cycle, at = [start], int(place[start])
        while at > start:
            cycle.append(at)
            at = int(place[at])
        if at == start and len(cycle) > 1:
            found.append(tuple(cycle))
    return found


def _place_findings(place: Ints) -> list[str]:
    """The permutation in sentences."""
    findings = []
    for cycle in cycles(place):
        numbers = [actuator + 1 for actuator in cycle]
        if len(numbers) == 2:
            findings.append(f"actuators {numbers[0]} and {numbers[1]} are exchanged")
        else:
            chain = ", ".join(
                f"{a} moves the surface at {b}" for a, b in zip(numbers, numbers[1:] + numbers[:1], strict=True)
            )
            findings.append(actuators_text(numbers, f"are permuted: {chain}"))
    return findings


def _sign_findings(sign: Floats, pushes: bool) -> list[str]:
    """Sentences on the signs (N,) of the responses; 0 = not known.

    Args:
        pushes: a rising signal raises the surface, as with stacks; membranes are pulled, bimorphs bend either way.
    """
    negative, known = sign < 0, np.count_nonzero(sign)
    if 2 * negative.sum() <= known:
        return _named(negative, "moves/move the surface the opposite way")
    if negative.sum() == known and not pushes:
        return []
    if negative.sum() == known:
        return [
            "all actuators move the surface the opposite way: a rising signal lowers it; "
            "check the sign of the maps and the polarity of the electronics"
        ]
    return _named(sign > 0, "moves/move the opposite way to most others, which lower the surface as the signal rises")


def _named(which: Bools, text: str) -> list[str]:
    """The finding on the actuators `which` (N,), as from `actuators_text`; nothing when there is none."""
    return [actuators_text(np.flatnonzero(which) + 1, text)] if which.any() else []
