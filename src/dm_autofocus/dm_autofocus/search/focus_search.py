"""The search of the node: from a few images where that is possible, else by sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import NDArray

from dm_autofocus.search.defocus_model import DefocusModel
from dm_autofocus.search.defocus_search import EXPECTED_IMAGES, DepthFromDefocus
from dm_autofocus.search.peak_search import Peak, PeakSearch, Phase, SearchConfig, Step


class FocusSearch:
    """A search from a few images where that is possible, and else, or when it gives up, a `PeakSearch`.

    Args:
        config: of both.
        model: of the camera, or the reason why there is none.
        start: where the mirror stands [1/m]; NaN = not known.

    Attributes:
        reason: why the range is swept; "" = it is not.
    """

    def __init__(self, config: SearchConfig, model: DefocusModel | str, start: float) -> None:
        self.reason = ""
        self._before = 0
        self._search: DepthFromDefocus | PeakSearch
        if isinstance(model, str):
            self._search, self.reason = PeakSearch(config), model
        else:
            self._search = DepthFromDefocus(config, model, start)

    @property
    def config(self) -> SearchConfig:
        """As given, the range as far as it was not refused."""
        return self._search.config

    @property
    def step(self) -> Step:
        """Where to go next; after the end, where to stand."""
        return self._search.step

    @property
    def phase(self) -> Phase:
        """COARSE or FINE."""
        return self._search.phase

    @property
    def done(self) -> bool:
        """Whether nothing more is to be fed."""
        return self._search.done

    @property
    def peak(self) -> Peak | None:
        """What was found."""
        return self._search.peak

    @property
    def measured(self) -> int:
        """Positions measured so far."""
        return self._before + self._search.measured

    @property
    def steps(self) -> int:
        """Positions to be measured, about."""
        expected = EXPECTED_IMAGES if isinstance(self._search, DepthFromDefocus) else self._before + self.config.steps
        return max(expected, self.measured)

    def feed(self, sharpness: float | None, images: Sequence[NDArray] = ()) -> None:
        """Report sharpness and images (H, W) at `step`; None when it was not to be measured."""
        if isinstance(self._search, PeakSearch):
            self._search.feed(sharpness)
            return
        assert sharpness is not None
        self._search.feed(sharpness, images)
        self._sweep_after_all()

    def refuse(self) -> None:
        """Report that the mirror cannot take `step`. Raises ValueError when hardly anything of the range is left."""
        self._search.refuse()
        self._sweep_after_all()

    def sweep(self, reason: str, approach: float) -> None:
        """Sweep the range instead, each sweep from `approach` [1/m] below it."""
        self.reason, self._before = reason, self.measured
        self._search = PeakSearch(replace(self.config, approach=approach))

    def _sweep_after_all(self) -> None:
        if isinstance(self._search, DepthFromDefocus) and self._search.gave_up:
            self.sweep(self._search.gave_up, 0.0)
