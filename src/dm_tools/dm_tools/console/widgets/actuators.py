"""The cards of the actuators: command map, poke, hysteresis loop."""

import contextlib
import dataclasses
import math
from functools import partial
from typing import Any

from nicegui import ui

from dm_tools.console import operations
from dm_tools.console.charts.command_map import command_map
from dm_tools.console.charts.plots import loop_chart
from dm_tools.console.console_node import Snapshot
from dm_tools.console.loops import modelled_loop
from dm_tools.console.session import Session
from dm_tools.console.status import reason_against
from dm_tools.console.view_models import Cell, cells, towards
from dm_tools.console.widgets.components import ActionButton, Chart, DecimalField, Line, WholeNumberField, card

ARROWS = {"right": 0.0, "up": math.pi / 2, "left": math.pi, "down": -math.pi / 2}


class ActuatorCards:
    """The command map, with the chosen actuator and its loop."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._cells: list[Cell] = []
        self._followed = session.chosen
        self._loop: tuple[Any, ...] = ()
        with ui.element("div").classes("pair"):
            with card("Command map"):
                with ui.element("div").classes("map w-full").props('tabindex="0" role="group"') as keys:
                    self._picture = Chart("square", lambda value: self._clicked(int(value[2])))
                keys.props('aria-label="Actuators. Arrow keys choose, Enter pokes, Escape releases"')
                for key, direction in ARROWS.items():
                    keys.on(f"keydown.{key}.prevent", partial(self._step, direction))
                keys.on("keydown.enter.prevent", self._poke)
                ui.label("▲▼ at a limit · … on its way · ! refused · ? doubtful grade · × not wired").classes("text")
            with card("Actuator"):
                self._text = Line("text figures", live=True)
                with ui.element("div").classes("line"):
                    self._number = WholeNumberField("Number", session.chosen, range(1, 2), self._typed).classes("w-20")
                    self._amplitude = DecimalField("Amplitude", 0.3).classes("w-24")
                with ui.element("div").classes("line"):
                    self._on_click = ui.switch("Poke by click")
                    self._with_map = ui.switch("Map after a poke", value=True)
                with ui.element("div").classes("line"):
                    self._poke_button = ActionButton("Poke", self._poke)
                    self._release = ActionButton("Release (Esc)", self._start_release, outline=True)
                    self._measure_loop = ActionButton("Measure its loop", self._start_loop, outline=True)
                self._reason = Line("reason")
                self._loop_text = Line("text figures")
                self._loop_picture = Chart("loop")
        ui.keyboard(on_key=self._key, ignore=[])

    # --- choosing ---

    def _clicked(self, number: int) -> None:
        self._choose(number)
        if self._on_click.value:
            self._poke()

    def _typed(self) -> None:
        with contextlib.suppress(ValueError):
            self._session.chosen = self._followed = self._number.valid_number

    def _choose(self, number: int) -> None:
        self._session.chosen = self._followed = number
        self._number.set_number(number)

    def _step(self, direction: float) -> None:
        if self._cells:
            self._choose(towards(self._cells, self._session.chosen, direction))

    def _key(self, event: Any) -> None:
        if event.action.keydown and event.key.escape and self._session.base is not None:
            self._start_release()

    # --- moving ---

    def _fields(self, title: str) -> tuple[int, float] | None:
        """Actuator, which may differ from the one shown, and amplitude as typed; None = refused, with a message."""
        try:
            return self._number.valid_number, self._amplitude.valid_number
        except ValueError as error:
            self._session.fail(title, str(error))
            return None

    def _poke(self) -> None:
        session, snapshot = self._session, self._session.snapshot()
        if (fields := self._fields("Poke")) is None:
            return
        title = f"Poke {fields[0]}"
        reason = reason_against("move", snapshot, session.running)
        if reason:
            session.fail(title, reason)
            return
        maps = bool(self._with_map.value) and not reason_against("measure", snapshot, "")
        session.begin(title, lambda _session: operations.poke(session, *fields, maps))

    def _start_release(self) -> None:
        self._session.begin("Release", operations.release)

    def _start_loop(self) -> None:
        session = self._session
        if (fields := self._fields("Loop")) is None:
            return
        title = f"Loop of actuator {fields[0]}"
        session.begin(title, lambda _session: operations.measure_loop(session, *fields), cancel="")

    # --- showing ---

    def refresh(self, snapshot: Snapshot) -> None:
        mirror, session = snapshot.mirror_info, self._session
        reason = reason_against("move", snapshot, session.running)
        self._poke_button.allow(reason)
        self._release.allow(reason or ("" if session.base is not None else "Nothing is poked."))
        self._measure_loop.allow(reason_against("converge", snapshot, session.running))
        self._reason.show(f"Not possible now: {reason}" if reason else "")
        if mirror is None:
            self._picture.show(None, "The driver has not published its actuators yet.")
            return
        self._cells = cells(mirror, snapshot.actuator_state, snapshot.calibration)
        self._number.allowed = range(1, len(self._cells) + 1)
        session.chosen = min(session.chosen, len(self._cells))
        if session.chosen != self._followed:  # chosen on another page
            self._choose(session.chosen)
        radius = 0.5e3 * mirror.working_aperture_diameter
        self._picture.show(command_map(self._cells, session.chosen, radius, mirror.signal_min, mirror.signal_max))
        cell, state = self._cells[session.chosen - 1], snapshot.actuator_state
        volts = f", {state.volts[session.chosen - 1]:.1f} V" if state is not None and len(state.volts) else ""
        limits = f"limits {mirror.signal_min:+g} to {mirror.signal_max:+g}"
        self._text.show(f"{cell.text[0].upper()}{cell.text[1:]}{volts}; {limits}.")
        self._show_loop(snapshot)

    def _show_loop(self, snapshot: Snapshot) -> None:
        session, mirror, calibration = self._session, snapshot.mirror_info, snapshot.calibration
        law = session.ros.observer.law
        if calibration is None or not law.has_history:
            fault = session.ros.observer.fault if calibration is not None else ""
            self._loop_text.show(f"The hysteresis in the calibration cannot be used: {fault}" if fault else "")
            self._loop = ()
            self._loop_picture.show(
                None, "No hysteresis was identified: a calibration with the plan “Hysteresis” does that."
            )
            return
        settled = session.ros.observer.now(snapshot.bench_time)
        signal, position = self._cells[session.chosen - 1].signal, None
        if settled.effective is not None and signal is not None:
            position = (signal, round(float(settled.effective[session.chosen - 1]), 4))
        measured = session.loops.get((calibration.id, session.chosen))
        key = (session.chosen, calibration.id, position, settled.doubt, id(measured))
        if key == self._loop:
            return
        self._loop = key
        loop = measured or modelled_loop(law, session.chosen, mirror.signal_min, mirror.signal_max)
        loop = dataclasses.replace(loop, position=position)
        doubt = f" Its place in the loop is a guess: {settled.doubt}." if settled.doubt else ""
        self._loop_text.show(f"Hysteresis as identified: {loop.text}; the cross marks its present state.{doubt}")
        self._loop_picture.show(loop_chart(loop))
