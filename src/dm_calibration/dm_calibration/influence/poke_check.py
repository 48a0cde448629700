"""Compare wiring and orientation with the configuration, from how the surface answers to each actuator.

Driving actuator i raises a broad bump over the place where that actuator stands. The bumps measured are correlated with
bumps expected at each configured position, for the eight ways a map can be turned or mirrored, and assigned one to one
(Hungarian method). What differs from the configuration is said in sentences.

A hexagonal layout looks the same after turns by 60 degrees, so that a map turned by 180 degrees cannot be told from a
numbering that starts on the other side: such findings name both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from dm_common.geometry import pitch
from dm_common.optics.piston_tilt import remove_piston_tilt, rms
from dm_common.optics.sampling import SamplePoints

Floats = NDArray[np.float64]

#: Widths tried for the expected bumps (standard deviation, in pitches); a stiffer plate answers more broadly.
WIDTHS = (0.7, 0.9, 1.15, 1.5)
#: Another orientation must beat the configured one by this much in mean correlation.
ORIENTATION_MARGIN = 0.05
#: A displaced actuator must fit its new place better than its own by this much in correlation.
PLACE_MARGIN = 0.10
#: A response that correlates less than this with any bump is not that of one actuator.
LIKENESS_MIN = 0.4
#: A symmetry of the layout explains the findings when no more than this share of the actuators disagrees with it.
SYMMETRY_REST = 0.25

#: The eight orientations of a map: name and the matrix that takes a configured position to where it appears.
ORIENTATIONS: dict[str, Floats] = {
    "as configured": np.array([[1, 0], [0, 1]], dtype=float),
    "turned by 180 degrees": np.array([[-1, 0], [0, -1]], dtype=float),
    "mirrored left to right": np.array([[-1, 0], [0, 1]], dtype=float),
    "mirrored top to bottom": np.array([[1, 0], [0, -1]], dtype=float),
    "turned by 90 degrees counter-clockwise": np.array([[0, -1], [1, 0]], dtype=float),
    "turned by 90 degrees clockwise": np.array([[0, 1], [-1, 0]], dtype=float),
    "mirrored about the rising diagonal": np.array([[0, 1], [1, 0]], dtype=float),
    "mirrored about the falling diagonal": np.array([[0, -1], [-1, 0]], dtype=float),
}


@dataclass(frozen=True)
class PokeCheck:
    """Outcome of a poke check.

    Attributes:
        orientation: a key of ORIENTATIONS.
        place: (N,) 0-based index of the configured actuator over whose position actuator i raised the surface.
        sign: (N,) +1 or -1: which way a rising signal moves the surface; 0 = not known.
        likeness: (N,) correlation of each response with the bump expected at `place`; 0 = no response.
        findings: sentences; empty = wiring and orientation are as configured.
    """

    orientation: str
    place: NDArray[np.int64]
    sign: NDArray[np.int64]
    likeness: Floats
    findings: tuple[str, ...] = field(default=())

    @property
    def passed(self) -> bool:
        return not self.findings


def check_pokes(
    response: Floats,
    points: SamplePoints,
    x: Floats,
    y: Floats,
    *,
    silent: NDArray[np.bool_] | None = None,
    unmoved: NDArray[np.bool_] | None = None,
) -> PokeCheck:
    """Compare measured responses with the configured layout.

    Args:
        response: (P, N) sag for a unit signal of each actuator, m; piston and tilt are ignored.
        points: the sampling points, of the unit disc.
        x, y: (N,) configured positions in units of the aperture radius.
        silent: (N,) actuators without a response above the noise; None = those without any.
        unmoved: (N,) actuators that were not driven: left out without a finding; None = none.
    """
    count = x.size
    if response.shape != (points.x.size, count):
        raise ValueError(f"response has the shape {response.shape}: must be {(points.x.size, count)}")
    measured = remove_piston_tilt(response.T, points)
    size = rms(measured, points.weight)
    untried = np.zeros(count, dtype=bool) if unmoved is None else unmoved
    quiet = size <= 1e-12 * size.max(initial=0.0) if silent is None else silent | (size == 0.0)
    active = np.flatnonzero(~(quiet | untried))
    quiet &= ~untried
    findings = (
        [_numbered("shows no response above the noise", "show no response above the noise", np.flatnonzero(quiet))]
        if quiet.any()
        else []
    )
    if active.size < 3:
        findings.append(f"only {active.size} actuators answer: wiring and orientation cannot be checked")
        zero = np.zeros(count, dtype=np.int64)
        return PokeCheck("as configured", np.arange(count), zero, np.zeros(count), tuple(findings))

    root = np.sqrt(points.weight)
    unit = root * measured[active] / size[active, None]
    tables = {
        name: _correlations(unit, root, points, matrix @ np.stack((x, y))) for name, matrix in ORIENTATIONS.items()
    }
    scores = {name: _assign(table)[1] for name, table in tables.items()}
    places = {name: _places(table, active, count) for name, table in tables.items()}
    top = max(scores.values())
    if scores["as configured"] + ORIENTATION_MARGIN > top:
        orientation = "as configured"
    else:
        # Orientations that map the layout onto itself fit alike: the one that leaves most actuators in place is it.
        alike = [name for name, score in scores.items() if score > top - ORIENTATION_MARGIN]
        orientation = min(alike, key=lambda name: int((places[name] != np.arange(count)).sum()))
    table, place = tables[orientation], places[orientation]
    likeness = np.zeros(count)
    likeness[active] = np.abs(table[np.arange(active.size), place[active]])
    sign = np.zeros(count, dtype=np.int64)
    sign[active] = np.sign(table[np.arange(active.size), place[active]]).astype(np.int64)

    if orientation != "as configured":
        findings.append(f"the map is {orientation} with respect to the actuators: check the orientation of the maps")
    findings += _sign_findings(sign, active)
    findings += _place_findings(place, active, x, y)
    unlike = active[likeness[active] < LIKENESS_MIN]
    if unlike.size:
        text = "does not look like that of one actuator"
        findings.append(_numbered(f"answers in a way that {text}", f"answer in a way that {text}", unlike))
    return PokeCheck(orientation, place, sign, likeness, tuple(findings))


def _correlations(unit: Floats, root: Floats, points: SamplePoints, positions: Floats) -> Floats:
    """(A, N) correlation of each unit response with a bump at each position, for the width that fits best in all."""
    distance = cdist(np.column_stack((points.x, points.y)), positions.T)
    step = pitch(*positions)
    best, best_score = np.zeros((len(unit), positions.shape[1])), -1.0
    for width in WIDTHS:
        expected = remove_piston_tilt(np.exp(-0.5 * np.square(distance / (width * step))).T, points)
        expected /= np.maximum(rms(expected, points.weight), np.finfo(float).tiny)[:, None]
        table = unit @ (root * expected).T
        score = _assign(table)[1]
        if score > best_score:
            best, best_score = table, score
    return best


def _assign(table: Floats) -> tuple[NDArray[np.int64], float]:
    """The place of each response, one to one, and the mean |correlation|."""
    rows, columns = linear_sum_assignment(-np.abs(table))
    return columns, float(np.abs(table)[rows, columns].mean())


def _places(table: Floats, active: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """(N,) the place of each actuator; moves that do not fit clearly better than staying are not believed."""
    place = np.full(count, -1)
    place[active] = _assign(table)[0]
    row = {int(actuator): i for i, actuator in enumerate(active)}
    free = sorted(set(range(place.size)) - set(place[active].tolist()))
    for actuator in sorted(set(range(place.size)) - set(active.tolist())):
        # A silent actuator keeps its own place when nobody else was found there.
        place[actuator] = free.pop(free.index(actuator)) if actuator in free else -1
    for index in np.flatnonzero(place < 0):
        place[index] = free.pop(0)
    for cycle in cycles(place):
        members = [actuator for actuator in cycle if actuator in row]
        gain = [abs(table[row[a], place[a]]) - abs(table[row[a], a]) for a in members]
        if not gain or float(np.mean(gain)) < PLACE_MARGIN:
            place[list(cycle)] = list(cycle)
    return place


def cycles(place: NDArray[np.int64]) -> list[tuple[int, ...]]:
    """The cycles of a permutation that are longer than 1, each from its smallest member on."""
    found = []
    seen: set[int] = set()
    for start in range(place.size):
        cycle = []
        at = start
        while at not in seen:
            seen.add(at)
            cycle.append(at)
            at = int(place[at])
        if len(cycle) > 1:
            found.append(tuple(cycle))
    return found


def _place_findings(place: NDArray[np.int64], active: NDArray[np.int64], x: Floats, y: Floats) -> list[str]:
    """The permutation in sentences: a symmetry of the layout when that says most of it, then exchanges and cycles."""
    if not cycles(place):
        return []
    findings = []
    text, symmetry = _nearest_symmetry(place, active, x, y)
    if text:
        findings.append(text)
        inverse = np.argsort(symmetry)
        place = inverse[place]
    for cycle in cycles(place):
        numbers = [actuator + 1 for actuator in cycle]
        if len(numbers) == 2:
            findings.append(f"actuators {numbers[0]} and {numbers[1]} are exchanged")
        else:
            chain = ", ".join(
                f"{a} moves the place of {b}" for a, b in zip(numbers, numbers[1:] + numbers[:1], strict=True)
            )
            findings.append(f"actuators {', '.join(map(str, numbers))} are permuted: {chain}")
    return findings


def _nearest_symmetry(
    place: NDArray[np.int64], active: NDArray[np.int64], x: Floats, y: Floats
) -> tuple[str, NDArray[np.int64]]:
    """The turn or mirror image of the layout that explains most of `place`: a sentence and a permutation."""
    identity = np.arange(x.size)
    best, best_text = identity, ""
    fewest = int((place != identity)[active].sum())
    for text, permutation in layout_symmetries(x, y):
        wrong = int((place != permutation)[active].sum())
        if wrong < fewest and wrong <= SYMMETRY_REST * active.size:
            fewest, best, best_text = wrong, permutation, text
    return best_text, best


def layout_symmetries(x: Floats, y: Floats) -> list[tuple[str, NDArray[np.int64]]]:
    """Turns by multiples of 60 degrees and mirror images that map the layout onto itself: sentences and permutations.

    Layouts without hexagonal symmetry simply have fewer of them.
    """
    place = x - x.mean() + 1j * (y - y.mean())
    turned = "start of the numbering in the rings, or the mirror or the map is turned"
    mirrored = "sense of the numbering in the rings, or a mirrored map"
    # Mirror axes of a hexagon lie every 30 degrees, its turns every 60.
    images = [
        (f"turned by {angle} degrees counter-clockwise: {turned}", place * np.exp(1j * np.radians(angle)))
        for angle in range(60, 360, 60)
    ] + [
        (f"mirrored about the axis at {angle} degrees: {mirrored}", place.conj() * np.exp(2j * np.radians(angle)))
        for angle in range(0, 180, 30)
    ]
    found = []
    for text, image in images:
        distance = np.abs(image[:, np.newaxis] - place)
        permutation = distance.argmin(axis=1)
        if distance.min(axis=1).max() < 0.1 * pitch(x, y) and np.unique(permutation).size == x.size:
            found.append((f"the whole pattern is {text}", permutation))
    return found


def _sign_findings(sign: NDArray[np.int64], active: NDArray[np.int64]) -> list[str]:
    negative = active[sign[active] < 0]
    if negative.size == 0:
        return []
    if negative.size == active.size:
        return [
            "all actuators move the surface the opposite way: a rising signal lowers it; "
            "check the sign of the maps and the polarity of the electronics"
        ]
    if 2 * negative.size > active.size:
        positive = active[sign[active] > 0]
        text = "the opposite way to most others, which lower the surface as the signal rises"
        return [_numbered(f"moves {text}", f"move {text}", positive)]
    return [_numbered("moves the surface the opposite way", "move the surface the opposite way", negative)]


def _numbered(singular: str, plural: str, actuators: NDArray[np.int64]) -> str:
    """ "actuator 3 <singular>" or "actuators 3, 7 <plural>"."""
    numbers = ", ".join(str(actuator + 1) for actuator in actuators)
    return f"actuator {numbers} {singular}" if actuators.size == 1 else f"actuators {numbers} {plural}"
