"""Scenes and cases to load, each with what its probe sees."""

from __future__ import annotations

import asyncio
import base64

from nicegui import ui

from us_sim.viewer.panels.while_shown import WhileShown
from us_sim.viewer.session import NOT_THERE, LoadableScene, SessionState
from us_sim.viewer.simulator import Simulator

AGAIN = "Ends the scene that runs, and starts it anew, without what was set in it"
ANOTHER = (
    "Ends the scene that runs, and starts this one; what was set in either comes back when it is "
    "loaded"
)
EVERY_S = 0.3
"""How often it is looked whether something has changed."""
BY_HAND = ("", "pose")
"""Trackers of scenes that differ from others in more than their tracker."""


class _Cases:
    """The panel of one page."""

    def __init__(self, simulator: Simulator) -> None:
        self._board = simulator.session
        self._shown: tuple[object, ...] = ()
        self._pictures: dict[str, ui.image] = {}
        with WhileShown(self._board.watch, self._board.unwatch, EVERY_S, self._refresh):
            self._state = ui.label().classes("us-session-state").props('role="status"')
            self._bar = ui.linear_progress(0.0, show_value=False, color="primary")
            self._bar.props('aria-label="Loading"')
            self._problem = ui.label().classes("us-session-problem").props('role="alert"')
            self._list = ui.column().classes("us-cases")

    def _refresh(self) -> None:
        board = self._board
        state = board.state
        self._state.set_text(_told(state))
        self._bar.set_visibility(state.is_busy)
        self._bar.set_value(state.fraction)
        self._problem.set_text(state.problem)
        self._problem.set_visibility(bool(state.problem))
        shown = (board.scenes, state.origin, state.is_there, state.is_busy)
        if shown != self._shown:
            self._shown = shown
            self._draw(state)
        for origin, picture in self._pictures.items():
            jpeg = board.thumbnail(origin)
            if jpeg is not None and not picture.source:
                picture.set_source(f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}")

    def _draw(self, state: SessionState) -> None:
        """All cards anew."""
        self._list.clear()
        self._pictures.clear()
        cases = [each for each in self._board.scenes if each.kind == "case"]
        scenes = [each for each in self._board.scenes if each.kind != "case"]
        with self._list:
            if not self._board.scenes and state.is_there:
                ui.label("What there is to load is being looked up …").classes("us-quiet")
            for title, listed in (
                ("Cases", cases),
                ("Scenes", [each for each in scenes if each.tracker in BY_HAND]),
            ):
                if listed:
                    ui.label(title).classes("us-cases-title")
                for each in listed:
                    self._card(each, state)
            others = [each for each in scenes if each.tracker not in BY_HAND]
            if others:
                tip = "The same bodies, for probes that a device tracks"
                with ui.expansion("With other trackers").classes("us-cases-more") as more:
                    more.props["title"] = tip
                    for each in others:
                        self._card(each, state)

    def _card(self, scene: LoadableScene, state: SessionState) -> None:
        is_loaded = scene.origin == state.origin
        with ui.card().classes("us-case") as card:
            if is_loaded:
                card.classes("us-case-loaded")
            with ui.row().classes("us-case-row"):
                picture = ui.image().classes("us-case-picture").props('fit="contain" no-spinner')
                picture.props["alt"] = f"{scene.name}: what the probe sees"
                self._pictures[scene.origin] = picture
                with ui.column().classes("us-case-text"):
                    ui.label(scene.name.replace("_", " ")).classes("us-case-name")
                    for text in (scene.region, scene.description, ", ".join(scene.structures)):
                        if text:
                            ui.label(text).classes("us-quiet")
                    if scene.problem:
                        ui.label(scene.problem).classes("us-session-problem")
            with ui.row().classes("us-case-foot"):
                ui.label("loaded" if is_loaded else "").classes("us-accent")
                button = ui.button(
                    "Load again" if is_loaded else "Load", on_click=lambda: self._load(scene)
                ).props("flat dense no-caps")
                button.props["aria-label"] = f"Load {scene.name}"
                button.set_enabled(state.is_there and not state.is_busy and not scene.problem)
                button.props["title"] = AGAIN if is_loaded else ANOTHER

    async def _load(self, scene: LoadableScene) -> None:
        state = self._board.state
        if state.record and not await self._is_sure(scene, state.record):
            return
        refused = await asyncio.wrap_future(self._board.ask(scene=scene.origin))
        if refused:
            ui.notify(refused, type="warning", multi_line=True)

    async def _is_sure(self, scene: LoadableScene, record: str) -> bool:
        """Ask, since the recording ends with its scene."""
        with ui.dialog() as dialog, ui.card():
            dialog.props["aria-label"] = "Load another scene"
            ui.label(f"Loading {scene.name} ends the recording {record}. It is kept as it is.")
            with ui.row():
                ui.button("Load", on_click=lambda: dialog.submit(True)).props("no-caps")
                ui.button("Go on recording", on_click=lambda: dialog.submit(False)).props(
                    "flat no-caps"
                )
        return bool(await dialog)


def _told(state: SessionState) -> str:
    """What runs, in a line."""
    if not state.is_there:
        return NOT_THERE
    done = f", {100 * state.fraction:.0f} %" if state.is_busy else ""
    return f"{state.scene.replace('_', ' ')}: {state.state}{done}"


def build(simulator: Simulator) -> None:
    """Make the panel."""
    _Cases(simulator)
