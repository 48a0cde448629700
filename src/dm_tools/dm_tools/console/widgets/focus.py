"""The card that asks for a curvature."""

import asyncio
import math

from dm_msgs.msg import FocusRequest
from nicegui import background_tasks, ui

from dm_common.errors import ErrorCode, Refusal
from dm_common.optics.conic import curvatures_text
from dm_tools.console import operations
from dm_tools.console.console_node import Snapshot
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.view_models import MODES, reachable
from dm_tools.console.widgets.components import ActionButton, DecimalField, Line, card

#: Step of the slider, 1/m.
STEP = 0.0005
#: Transient refusals of a prediction, which say nothing about the shape, and the time until it is tried again, s.
TRANSIENT, RETRY_S = (ErrorCode.TIMEOUT, ErrorCode.BUSY, ErrorCode.DRIVER_UNAVAILABLE), 2.0


class FocusCard:
    """Slider, mode, prediction, and the buttons that move the mirror."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._range: tuple[float, float] | None = None
        self._requested = self._predicting = self._typing = False
        self._inputs: tuple[object, ...] = ()  # the fields, and everything else that a prediction depends on
        self._predicted: tuple[object, ...] = ()  # the fields of the latest prediction
        with card("Focus"):
            self._text = Line("text figures")
            self._slider = ui.slider(min=-0.05, max=0.05, step=STEP, value=0.0, on_change=self._slid)
            self._slider.props('aria-label="Curvature in 1 per metre" label switch-label-side')
            with ui.element("div").classes("line"):
                self._number = DecimalField("Curvature, 1/m", 0.0, self._typed).classes("w-36")
                self._conic = DecimalField("Conic constant", 0.0).classes("w-28")
                self._power = Line("text figures")
            self._mode = ui.radio(MODES, value=FocusRequest.MODE_AUTO).props('inline aria-label="Mode"')
            with ui.element("div").classes("prediction"):
                self._prediction = Line("text figures", live=True)
            with ui.element("div").classes("line"):
                self._move = ActionButton("Move", session.begin, "Move", operations.move, self._request, "move_focus")
                self._flatten = ActionButton("Flatten", session.begin, "Flatten", operations.flatten, outline=True)
                self._degauss = ActionButton("Degauss", session.begin, "Degauss", operations.degauss, outline=True)
                self._converge = ActionButton(
                    "Converge", session.begin, "Converge", operations.converge, self._request, "converge", outline=True
                )
            self._reason = Line("reason")

    def _slid(self) -> None:
        if not self._typing:
            self._number.set_number(round(float(self._slider.value or 0.0), 4))

    def _typed(self) -> None:
        value = self._number.number
        if value is not None and self._range is not None and self._range[0] <= value <= self._range[1]:
            self._typing = True  # what was typed must not be rounded to the slider's steps
            self._slider.set_value(value)
            self._typing = False

    def _request(self) -> FocusRequest:
        """The request in the fields. Raises ValueError naming the one that is not a number."""
        curvature, conic_constant = self._number.valid_number, self._conic.valid_number
        return FocusRequest(curvature=curvature, conic_constant=conic_constant, mode=str(self._mode.value))

    def refresh(self, snapshot: Snapshot) -> None:
        session = self._session
        reason = reason_against("focus", snapshot, session.running)
        self._move.allow(reason)
        self._flatten.allow(reason)
        self._degauss.allow(reason_against("move", snapshot, session.running))
        self._converge.allow(reason_against("converge", snapshot, session.running))
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        self._take_range(snapshot)
        value = self._number.number
        self._power.show(f"= {2 * value:+.4f} dioptre" if value is not None else "")
        # What is no number counts as typed: the refusal names it.
        fields = [field.value if field.number is None else field.number for field in (self._number, self._conic)]
        inputs = (*fields, self._mode.value, *self._prediction_basis(snapshot))
        if against := reason_against("focus", snapshot, ""):
            self._prediction.classes(remove="refused")
            self._prediction.show(f"No prediction. {against}")
            self._inputs = ()  # one is made as soon as that has passed
            return
        if inputs[:3] != self._predicted:
            self._prediction.show("")
        if inputs != self._inputs:
            self._inputs, self._requested = inputs, False
        elif not (reason or self._requested or self._predicting):  # unchanged since the last refresh
            self._requested = self._predicting = True
            self._predicted = inputs[:3]
            background_tasks.create(self._predict())

    def _prediction_basis(self, snapshot: Snapshot) -> tuple[object, ...]:
        """What a prediction depends on beside the fields: bounds, recipes, signals, known history, operation."""
        able, state, book = snapshot.capabilities, snapshot.actuator_state, snapshot.recipes
        promised = (able.calibration_id, able.error_bound, able.error_bound_conditioned) if able is not None else ()
        recipes = [str(recipe.stamp) for recipe in book.recipes] if book is not None else ()
        signals = () if state is None else (state.history_known, *(round(each, 1) for each in state.requested))
        return *promised, *recipes, *signals, self._session.running  # corrections of creep are below the rounding

    def _take_range(self, snapshot: Snapshot) -> None:
        capabilities = snapshot.capabilities
        found = reachable(capabilities)
        if found is None:
            calibrated = capabilities is not None and capabilities.calibration_id
            reason = capabilities.message if calibrated else "not known without a calibration"
            self._text.show(f"Reachable range: {reason}.")
            self._slider.set_enabled(False)
            return
        self._slider.set_enabled(True)
        conditioned = capabilities.error_bound_conditioned
        extra = f", conditioned {conditioned * 1e9:.1f} nm" if conditioned > 0 else ""
        self._text.show(
            f"Reachable {curvatures_text(*found)}.\n95 % bound on a coefficient error, in addition to the predicted "
            f"error and creep: {capabilities.error_bound * 1e9:.1f} nm{extra}."
        )
        if found != self._range:
            self._range = found
            # Set as numbers: values that `props()` parses from a string stay strings, and the slider ignores the mouse.
            self._slider.props["min"] = round(math.ceil(found[0] / STEP) * STEP, 4)
            self._slider.props["max"] = round(math.floor(found[1] / STEP) * STEP, 4)
            self._typed()  # the slider could not follow before

    async def _predict(self) -> None:
        try:
            text = await operations.predict(self._session, self._request())
            self._prediction.classes(remove="refused")
            self._prediction.show(text)
        except (Refusal, ValueError) as error:
            self._prediction.classes(add="refused")
            self._prediction.show(str(error))
            if isinstance(error, Refusal) and error.error_code in TRANSIENT:
                await asyncio.sleep(RETRY_S)
                self._inputs = ()
        finally:
            self._predicting = False
