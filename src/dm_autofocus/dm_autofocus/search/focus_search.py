"""The search of the node: from a few images if that is possible, else by sweeps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.defocus_search import EXPECTED_IMAGES, DepthFromDefocus
from dm_autofocus.search.peak_search import PeakSearch, SearchConfig

#: Most restarts of a search because the images change their size.
MOST_CHANGES = 3


class FocusSearch:
    """A search from a few images if that is possible; otherwise, or when it gives up, a `PeakSearch`.

    Args:
        config: of both.
        model: of the camera, or the reason why there is none.
        start: present curvature of the mirror [1/m]; NaN = not known.

    Attributes:
        current: the search in progress, with its `step`, `phase`, `done`, `peak` and `config`.
        reason: why the range is swept; "" = it is not.
        unexplained: whether it is swept because the model did not find the focus.
    """

    def __init__(self, config: SearchConfig, model: DefocusModel | str, start: float) -> None:
        self._model = None if isinstance(model, str) else model
        self.reason, self.unexplained = model if isinstance(model, str) else "", False
        self._before = self._changes = 0
        self._shapes = {self._model.shape} if self._model else set()  # of the images, (H, W) each
        self._seen: list[tuple[float, NDArray, float]] = []  # place, powers and sharpness of each image
        self.current: DepthFromDefocus | PeakSearch
        self.current = DepthFromDefocus(config, self._model, start) if self._model else PeakSearch(config)

    @property
    def measured(self) -> int:
        """Positions measured so far."""
        return self._before + self.current.measured

    @property
    def steps(self) -> int:
        """Approximate number of positions to be measured."""
        swept = isinstance(self.current, PeakSearch)
        return max(self._before + self.current.config.steps if swept else EXPECTED_IMAGES, self.measured)

    def feed(self, sharpness: float | None, images: Sequence[NDArray] = ()) -> None:
        """Report sharpness and images (H, W) at `current.step`; None if `step` was not to be measured.

        Raises:
            ValueError: the images change their size again and again: their sharpness cannot be compared.
        """
        powers, seen, shapes = self._powers(images), sharpness, {image.shape for image in images}
        changed = bool(shapes and self._shapes) and shapes != self._shapes
        self._shapes = shapes or self._shapes
        if sharpness is None:
            pass
        elif powers is None:
            self._seen.clear()  # the images are of another size: their sharpness cannot be compared with the earlier
        else:
            assert self._model is not None  # else there are no powers
            seen = self._model.sharpness(powers)
            self._seen.append((self.current.step.curvature, powers, sharpness))
        if changed:
            self._changes += 1
            if self._changes > MOST_CHANGES:
                raise ValueError("the images change their size again and again")
            self.sweep("the images changed their size", self.current.config.approach)
        elif isinstance(self.current, PeakSearch):
            self.current.feed(seen)
        else:
            assert seen is not None and powers is not None, "it measures every step"
            self.current.feed(seen, powers)
            self._sweep_after_all()
        if self.current.done and self.current.peak is not None and self._seen:
            place = self.current.peak.curvature
            nearest = min(self._seen, key=lambda image: abs(image[0] - place))
            self.current.peak = replace(self.current.peak, sharpness=nearest[2])

    def _powers(self, images: Sequence[NDArray]) -> NDArray | None:
        """Mean powers (K,) of images; None without a model, or where they are not of its size."""
        model = self._model
        if model is None or not images or any(image.shape != model.shape for image in images):
            return None
        return np.mean([model.powers(image) for image in images], axis=0)

    def refuse(self) -> None:
        """Report that the mirror cannot take the step. Raises ValueError when hardly anything of the range is left."""
        self.current.refuse()
        self._sweep_after_all()

    def sweep(self, reason: str, approach: float) -> None:
        """Sweep the range instead, each sweep beginning `approach` [1/m] below its first position."""
        self.reason, self._before = reason, self.measured
        self.current = PeakSearch(replace(self.current.config, approach=approach))

    def fitting_scale(self) -> float:
        """Factor on the focal length that explains the images; 1 = the given one does, or not known."""
        if self._model is None or self.current.peak is None or not self._seen:
            return 1.0
        places, powers, _sharpness = (np.array(part) for part in zip(*self._seen, strict=True))
        return self._model.fitting_scale(self.current.peak.curvature, places, powers)

    def _sweep_after_all(self) -> None:
        if isinstance(self.current, DepthFromDefocus) and self.current.gave_up:
            self.unexplained = True
            self.sweep(self.current.gave_up, 0.0)
