"""Search of the focus with a few images: how their power changes with the focus, compared with the optics.

A state machine as `PeakSearch`, for a mirror that reaches the curvatures it is sent to. Each image adds information on
every possible place of the object (`DefocusModel`): the texture's own power in each band is taken as whatever explains
the images best, so only ratios between images count (depth from defocus [31, 32]). The next image is taken at the most
probable place, or in the widest gap while nothing was seen that changes with focus. An image on either side then
confirms it: the top must be sharper than both. The result is the mean of the probability density that follows from the
images near it, two on either side: the errors of a pupil that is not ideal are equal and opposite on the two sides.
"""

import math

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import TRANSFER_ERROR, DefocusModel
from dm_autofocus.search.peak_search import (
    MOST_REFUSALS,
    NOISE_POINTS,
    Peak,
    Phase,
    Search,
    SearchConfig,
    Step,
    is_hill,
)
from dm_common import Bools, Floats

#: By how much a place must explain the images better than a scene that focus does not change (2 x log likelihood).
EVIDENCE = 25.0
#: The same when the search ends. Of 4160 scenes without anything to see, 14 reached 26 to 42 by chance; scenes with a
#: texture of 5 % contrast and more end at 100 or above.
CERTAIN = 60.0
#: Reason to give up.
UNEXPLAINED = "the optics do not explain how the images change with focus"
#: Most images after the first sign of a change with focus, and the number that most searches need.
MOST_IMAGES, EXPECTED_IMAGES = 18, 10
#: Smallest and largest step to either side of the focus, and how far beyond the range objects are considered, in depths
#: of focus. The last images are one and two steps to either side.
SIDE, SIDE_MAX, BEYOND = 3.0, 9.0, 10.0
#: Share of the least power of all images that may have blurred in from outside the region.
STRAY = 0.5
#: Only images within HILL depths of focus of the sharpest count, if it exceeds the least sharp one by OUTSTANDING times
#: as much as all images further away do, of which there must be at least FAR_IMAGES.
OUTSTANDING, HILL, FAR_IMAGES = 3.0, 20.0, 2
#: Places of the last images, and of further ones while the standard error is above PRECISION, in steps.
LAST, MORE = (-1, 1, -2, 2), (-1.5, 1.5, -2.5, 2.5, -0.6, 0.6)
#: Standard error below which no further images are needed, in depths of focus.
PRECISION = 0.25
#: Largest standard error of a place that is accepted, in depths of focus; most times that a fit is centred anew.
WORST, RECENTRED = 1.5, 3
#: Distance from the focus, in depths of focus, beyond which blur exceeds aberrations; relative error of its transfer.
BLURRED, ERROR = 1.25, 0.17


class DepthFromDefocus(Search):
    """A search with a few images, until it ends or gives up.

    Args:
        config: range and tolerance.
        model: of the camera.
        start: present curvature of the mirror [1/m]; NaN = not known.

    Attributes:
        gave_up: the reason why the images cannot be explained; "" = they can.
    """

    def __init__(self, config: SearchConfig, model: DefocusModel, start: float) -> None:
        super().__init__(config)
        self.gave_up = ""
        self._model = model
        tolerance = config.tolerance
        self._grid = np.arange(config.low - BEYOND * tolerance, config.high + BEYOND * tolerance, tolerance / 4)
        self._places: list[float] = []
        self._powers: list[Floats] = []
        self._sharpness: list[float] = []
        self._evidence = 0.0
        self._blind = 0  # number of images up to the last after which it was open whether focus changes anything
        quarter = (config.high - config.low) / 4
        below, above = config.low + quarter, config.high - quarter
        self._first = (above, below) if abs(start - above) < abs(start - below) else (below, above)
        self.step = Step(self._first[0])

    def feed(self, sharpness: float, powers: Floats) -> None:
        """Report the sharpness of an image at `step` and its powers (K,), see `DefocusModel.powers`."""
        self._places.append(self.step.curvature)
        self._sharpness.append(sharpness)
        self._powers.append(powers)
        self.measured += 1
        if self.measured < 2:
            self.step = Step(self._first[1])
        else:
            self._aim()

    def refuse(self) -> None:
        """Report that the mirror cannot take `step`: the range ends before it.

        Raises:
            ValueError: hardly anything of the range is left.
        """
        self.step = Step(float(np.clip(self.step.curvature, *self._draw_in())))
        self._refusals += 1
        if self._refusals > MOST_REFUSALS:
            self._give_up("the mirror refuses too much of the range")

    def _aim(self) -> None:
        """Choose the next step, or end."""
        config, tolerance = self.config, self.config.tolerance
        places, powers, grid = np.array(self._places), np.array(self._powers), self._grid
        # Images may be outside a range that was reduced since: they are not candidates for the focus.
        inside = (places >= config.low) & (places <= config.high)
        sharpness = np.where(inside, self._sharpness, -np.inf)
        misfit, evidence = self._model.judge(grid, places, powers, TRANSFER_ERROR, STRAY)
        self._evidence = evidence
        if evidence < EVIDENCE:
            self._blind = self.measured
            self._fill_gap(places)
            return
        hill = self._hill(places, sharpness)
        if not hill.all():
            top = places[sharpness.argmax()]
            grid = grid[np.abs(grid - top) < HILL * tolerance]
            some = hill if hill.sum() > 1 else slice(None)
            misfit, self._evidence = self._model.judge(grid, places[some], powers[some], TRANSFER_ERROR)
        _place, spread = _mean_and_spread(grid, misfit)
        best = float(np.clip(grid[misfit.argmin()], config.low, config.high))
        side = float(np.clip(2 * spread, SIDE * tolerance, SIDE_MAX * tolerance))
        near = np.abs(places - best) < 2 * side
        if np.where(inside, np.abs(places - best), np.inf).min() > 0.4 * side:
            self._go(best)
        else:
            self.phase = Phase.FINE
            self._confirm(places, sharpness, int(np.where(near, sharpness, -np.inf).argmax()), side)

    def _hill(self, places: Floats, sharpness: Floats) -> Bools:
        """Images that count: those near the sharpest if it is far sharper than all others, else all.

        In images far from the focus, objects at other distances beside the region blur into it.
        """
        near = np.abs(places - places[sharpness.argmax()]) < HILL * self.config.tolerance
        above = np.array(self._sharpness) - min(self._sharpness)
        if (~near).sum() >= FAR_IMAGES and above[near].max() > OUTSTANDING * above[~near].max():
            return near
        return np.ones(len(places), bool)

    def _confirm(self, places: Floats, sharpness: Floats, top: int, side: float) -> None:
        """Take a missing image on either side of the sharpest one; if there are both, end."""
        tolerance, offset = self.config.tolerance, places - places[top]
        three = [top]
        for sign in (-1, 1):
            within = np.isfinite(sharpness) & (sign * offset > 0.4 * side) & (sign * offset < 2 * side)
            if within.any():
                three.append(int(np.where(within, np.abs(np.abs(offset) - side), np.inf).argmin()))
                continue
            wanted = float(np.clip(places[top] + sign * side, self.config.low, self.config.high))
            if abs(wanted - places[top]) > 0.4 * side:
                self._go(wanted)
                return
        if sharpness[top] < sharpness.max():
            # Other objects in the picture can mislead the model, but not the sharpness.
            self._confirm(places, sharpness, int(sharpness.argmax()), side)
            return
        place, error = self._fit(places, places[top], side)
        steps = LAST if error < PRECISION * tolerance else LAST + MORE
        for wanted in place + side * np.array(steps):
            free = np.abs(places - wanted).min() > 0.3 * side
            if free and self._more and self.config.low <= wanted <= self.config.high:
                self.step = Step(float(wanted))
                return
        if self._evidence < CERTAIN:
            self._give_up("so little changes with the focus that it may be noise")
            return
        at_limit = len(three) < 3 and min(place - self.config.low, self.config.high - place) < tolerance
        if error > WORST * tolerance and not at_limit:
            self._give_up(UNEXPLAINED)
            return
        self.peak = Peak(place, float(sharpness[top]), at_limit, error)
        self.step = Step(place)
        self.done = True

    def _fit(self, places: Floats, centre: float, side: float) -> tuple[float, float]:
        """Place of the focus and its standard error by the images around a centre [1/m].

        Aberrations change the images in focus most, and these images say least about the place: they are used only if
        there are too few on either side. If the place is far from the centre, the fit is repeated about that place:
        near the end of its grid it would seem certain. The error includes that of the images and the scatter of the
        place when one of them is left out.
        """
        powers = np.array(self._powers)

        def fit(some: NDArray[np.intp]) -> tuple[float, float]:
            grid = centre + 1.5 * side * np.linspace(-1, 1, 73)
            grid = grid[(grid >= self.config.low) & (grid <= self.config.high)]
            return _mean_and_spread(grid, self._model.judge(grid, places[some], powers[some], ERROR)[0])

        some = np.flatnonzero(np.abs(places - centre) < 3 * side)
        place, spread = fit(some)
        for _round in range(RECENTRED):
            near = np.flatnonzero(np.abs(places - place) < 3 * side)
            if abs(place - centre) < side or not near.size:
                break
            centre, some = place, near
            place, spread = fit(some)
        off = (places[some] - place) / self.config.tolerance
        if min((off < -BLURRED).sum(), (off > BLURRED).sum()) >= 2:
            some = some[np.abs(off) > BLURRED]
            place, spread = fit(some)
        if len(some) < 2:
            return place, spread
        without = np.array([fit(np.delete(some, number))[0] for number in range(len(some))])
        return place, math.hypot(spread, math.sqrt(len(some) - 1) * float(without.std()))

    def _fill_gap(self, places: Floats) -> None:
        """Choose the middle of the widest gap; end if none is wide enough to hide a focus.

        Gaps are divided into equal parts, not halved, so that no more images are needed than a sweep takes.
        """
        low, high, points = self.config.low, self.config.high, self.config.coarse_points
        ends = np.sort([low, *np.clip(places, low, high), high])
        gap = int(np.diff(ends).argmax())
        width = float(np.diff(ends)[gap])
        parts = math.ceil(width * (points - 1) / (high - low) - 1e-6)
        if parts < 2 and self.measured < NOISE_POINTS:
            self.step = Step(float(places[np.argmax(self._sharpness)]))
        elif parts < 2 and is_hill(np.array(self._sharpness)[places.argsort()], self.config.least_contrast):
            # For example objects at several distances: a search by sharpness needs no optics.
            self._give_up(UNEXPLAINED)
        elif parts < 2:
            self.done = True
            self.step = Step(float(places[-1]))
        elif self.measured >= points:
            self._give_up("even this many images do not show whether focus changes them")
        else:
            self.step = Step(float(ends[gap]) + width * (parts // 2) / parts)

    @property
    def _more(self) -> bool:
        """Whether another image may be taken."""
        return self.measured - self._blind < MOST_IMAGES

    def _go(self, place: float) -> None:
        if self._more:
            self.step = Step(place)
        else:
            self._give_up(UNEXPLAINED)

    def _give_up(self, reason: str) -> None:
        self.gave_up, self.done = reason, True


def _mean_and_spread(grid: Floats, misfit: Floats) -> tuple[float, float]:
    """Mean and standard deviation of the place, from twice its negative log likelihood."""
    weights = np.exp((misfit.min() - misfit) / 2)
    weights /= weights.sum()
    mean = float(weights @ grid)
    return mean, float(np.sqrt(weights @ (grid - mean) ** 2))
