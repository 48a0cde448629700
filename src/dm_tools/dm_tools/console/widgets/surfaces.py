"""The cards of the surface: measured, predicted, difference, and Zernike coefficients."""

from typing import Any

import numpy as np
from nicegui import ui

from dm_common.messages import stamp_ns
from dm_tools.console import operations
from dm_tools.console.charts.plots import DIFFERENCE_COLOURS, SAG_COLOURS, heat_map, zernike_chart
from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.surface_view import SurfaceView
from dm_tools.console.surfaces import Surface
from dm_tools.console.view_models import bars
from dm_tools.console.widgets.components import ActionButton, Chart, Line, card

#: Percentage of the pixels that the scale of a difference covers: a few stray ones must not flatten it.
COVERED = 99.5
#: Title of the second panel; True = the prediction is for the moment of the map.
PREDICTED = {True: "Predicted for the map", False: "Predicted now"}
#: What the bars show; True = a difference.
KINDS = {True: "Measured − predicted", False: "Measured"}


class SurfaceCard:
    """Three heat maps."""

    def __init__(self, session: Session, view: SurfaceView) -> None:
        self._session, self._view = session, view
        self._shown: tuple[Any, ...] = ()
        self._panels: list[tuple[Chart, Line]] = []
        self._names: list[ui.label] = []
        with card("Surface"):
            with ui.element("div").classes("line"):
                self._measure = ActionButton("Measure", session.begin, "Measure", operations.measure)
                self._then = ui.switch("Prediction of the moment of the map", value=True)
                self._when = Line("text")
            self._reason = Line("reason")
            with ui.element("div").classes("panels"):
                for name in ("Measured", PREDICTED[True], "Measured − predicted"):
                    with ui.element("div").classes("panel"):
                        self._names.append(ui.label(name).classes("text").style("font-weight: 600"))
                        self._panels.append((Chart("heat"), Line("text figures")))

    def refresh(self, snapshot: Snapshot) -> None:
        reason = reason_against("measure", snapshot, self._session.running)
        self._measure.allow(reason)
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        view = self._view
        view.update(snapshot)
        key = (view.version, self._then.value)
        if key == self._shown:
            return
        self._shown = key
        self._when.show(view.when)
        predicted = (self._then.value and view.predicted_then) or view.predicted
        self._names[1].set_text(PREDICTED[predicted is view.predicted_then])
        limit = max([s.extent for s in (view.measured, predicted) if isinstance(s, Surface)], default=np.nan)
        self._panel(0, view.measured, limit, SAG_COLOURS, "measured surface")
        text = " ".join([f"A guess until a degauss: {view.doubt}." if view.doubt else "", view.remark]).strip()
        self._panel(1, predicted, limit, SAG_COLOURS, "predicted surface", text)
        gap = view.difference
        extent = float(np.nanpercentile(np.abs(gap.sag), COVERED)) if isinstance(gap, Surface) else np.nan
        self._panel(2, gap, extent, DIFFERENCE_COLOURS, "measured minus predicted")

    def _panel(
        self, place: int, surface: Surface | str, limit: float, colours: str, name: str, remark: str = ""
    ) -> None:
        picture, text = self._panels[place]
        if isinstance(surface, str):
            picture.show(None, surface)
            text.show("")
            return
        picture.show(heat_map(surface, limit, colours, name))
        text.show(
            f"Peak to valley {surface.peak_to_valley * 1e9:.1f} nm, rms {surface.rms * 1e9:.2f} nm, "
            f"piston and tilt removed. {remark}"
        )


class ZernikeCard:
    """Bars of the coefficients of the latest map."""

    def __init__(self, view: SurfaceView) -> None:
        self._view = view
        with card("Zernike coefficients"):
            self._kind = ui.radio(KINDS, value=True).props('inline aria-label="What the bars show"')
            self._bars = Chart("bars")
            self._note = Line("text")

    def refresh(self, snapshot: Snapshot) -> None:
        zernike, wanted = snapshot.zernike, bool(self._kind.value)
        of_this_map = zernike is not None and stamp_ns(zernike.header.stamp) == self._view.stamp
        predicted = self._view.predicted_zernike if of_this_map else None
        as_difference = wanted and predicted is not None
        found = bars(zernike, predicted, as_difference) if zernike is not None else []
        self._bars.show(zernike_chart(found, KINDS[as_difference]) if found else None, "No map was measured yet.")
        text = ["Terms beyond tilt with their 95 % intervals from the fit of the map."] if found else []
        if found and predicted is not None and not as_difference:
            text.append("The diamond is the prediction for the moment of the map.")
        if found and wanted and not as_difference:
            text.append("Shown as measured.")
            text += [self._view.difference] if isinstance(self._view.difference, str) else []
        self._note.show(" ".join(text))
