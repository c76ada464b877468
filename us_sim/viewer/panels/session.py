"""Panels of the session: scenes and cases to load, recording, and replay."""

from __future__ import annotations

import time
from collections.abc import Awaitable
from datetime import datetime
from pathlib import PurePath
from typing import Any

from nicegui import ui

from us_sim.scene.listing import ListedScene
from us_sim.viewer.panels.asking import ask_session, enable_control, notify_refusal
from us_sim.viewer.panels.controls import WhileShown
from us_sim.viewer.score import get_score
from us_sim.viewer.session import NOT_THERE, SessionState
from us_sim.viewer.stream import PageSources

AGAIN = "Ends the scene that runs, and starts it anew, without what was set in it"
ANOTHER = "Ends the scene that runs, and starts this one, without what was set in that"
EVERY_S = 0.3  # between two refreshes of the panels
BY_HAND = ("", "pose")  # trackers of the main scenes; others differ from these in the tracker only


class CasesPanel:
    """The panel of scenes and cases to load."""

    def __init__(self, sources: PageSources) -> None:
        self._sources, self._board = sources, sources.session
        self._shown: tuple[object, ...] = ()
        with WhileShown(self._board.add_page, self._board.remove_page, EVERY_S, self._refresh):
            self._state = ui.label().classes("us-session-state").props('role="status"')
            self._bar = ui.linear_progress(0.0, show_value=False, color="primary")
            self._bar.props('aria-label="Loading"')
            self._problem = ui.label().classes("us-session-problem").props('role="alert"')
            self._list = ui.column().classes("us-cases")

    def _refresh(self) -> None:
        board = self._board
        state = board.state
        self._state.set_text(_describe_loading(state))
        self._bar.set_visibility(state.is_busy)
        self._bar.set_value(state.fraction)
        self._problem.set_text(state.problem)
        self._problem.set_visibility(bool(state.problem))
        shown = (board.scenes, state.origin, state.is_there, state.is_busy)
        if shown != self._shown:
            self._shown = shown
            self._draw(state)

    def _draw(self, state: SessionState) -> None:
        self._list.clear()
        usable = [each for each in self._board.scenes if not each.problem]
        cases, scenes, exercises = (
            [each for each in usable if each.kind == kind] for kind in ("case", "scene", "exercise")
        )
        with self._list:
            if not self._board.scenes and state.is_there:
                ui.label("What there is to load is being looked up …").classes("us-quiet")
            for title, listed in (
                ("Exercises", exercises),
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

    def _card(self, scene: ListedScene, state: SessionState) -> None:
        is_loaded = scene.origin == state.origin.partition("#")[0]
        with ui.card().classes("us-case") as card:
            if is_loaded:
                card.classes("us-case-loaded")
            with ui.column().classes("us-case-text"):
                ui.label(scene.name.replace("_", " ")).classes("us-case-name")
                for text in (scene.region, scene.description, ", ".join(scene.structures)):
                    if text:
                        ui.label(text).classes("us-quiet")
                if scene.problem:
                    ui.label(scene.problem).classes("us-session-problem")
            with ui.row().classes("us-case-foot"):
                ui.label("loaded" if is_loaded else "").classes("us-accent")
                label = "Load again" if is_loaded else "Load"
                button = ui.button(label, on_click=lambda: ask_to_load(self._sources, scene))
                button.props("flat dense no-caps").props["aria-label"] = f"{label} {scene.name}"
                button.props["title"] = AGAIN if is_loaded else ANOTHER
                enable_control(button, state.is_there and not state.is_busy and not scene.problem)


async def ask_to_load(sources: PageSources, scene: ListedScene) -> bool:
    """Load a scene, if the person agrees to what ends with the present one.

    Returns:
        whether the scene is being loaded.
    """
    record, score = sources.session.state.record, get_score(sources)
    ends = [f"the recording {record}, which is kept as it is"] if record else []
    ends += [f"the attempt at {score['name']}"] if score.get("state") == "running" else []
    sentence = f"Loading {scene.name} ends {', and '.join(ends)}."
    if ends and not await ask_confirmation("Load", sentence):
        return False
    return not notify_refusal(await ask_session(sources.session, scene=scene.origin))


async def ask_confirmation(what: str, sentence: str) -> bool:
    """Ask the person for agreement; return the answer."""
    with ui.dialog() as dialog, ui.card():
        dialog.props["aria-label"] = what
        ui.label(sentence)
        with ui.row():
            ui.button(what, on_click=lambda: dialog.submit(True)).props("no-caps")
            ui.button("Go on", on_click=lambda: dialog.submit(False)).props("flat no-caps")
    return bool(await dialog)


def _describe_loading(state: SessionState) -> str:
    if not state.is_there:
        return NOT_THERE
    done = f", {100 * state.fraction:.0f} %" if state.is_busy else ""
    return f"{state.scene.replace('_', ' ')}: {state.state}{done}"


SETTLE_S = 1.5  # from an answer to its effect; meanwhile controls stay as a person has set them
RATES = {0.1: "0.1 ×", 0.25: "0.25 ×", 0.5: "0.5 ×", 1.0: "1 ×", 2.0: "2 ×", 4.0: "4 ×"}
KINDS = {"path": "Probe's path", "recording": "All as recorded"}
KINDS_TOLD = (
    "The probe's path moves the probe of the simulation. All as recorded takes the simulation's "
    "place; when you end it the nodes start again, without what was set in them"
)


class SessionPanel:
    """The panel that records, and replays recordings."""

    def __init__(self, sources: PageSources) -> None:
        self._board = sources.session
        self._sought: float | None = None  # s, time that a person seeks, until the replay is there
        self._is_pointing = False
        self._asking = 0  # requests without an answer
        self._answered = 0.0  # s, monotonic, of the last answer
        self._is_following = False  # the program sets the controls, not a person
        self._shown_record = ""  # the recording whose name the field shows
        self._proposed = _propose_name()
        with WhileShown(self._board.add_page, self._board.remove_page, EVERY_S, self._refresh):
            self._absent = ui.label(NOT_THERE).classes("us-quiet")
            with ui.column().classes("us-session") as self._all:
                self._problem = ui.label().classes("us-session-problem").props('role="alert"')
                self._recording()
                ui.separator()
                self._replaying()

    def _recording(self) -> None:
        ui.label("Record").classes("us-cases-title")
        self._file = (
            ui.input("file", value=self._proposed).props("dense outlined").classes("us-wide-field")
        )
        folder = self._board.folder or "the folder that us-sim runs in"
        self._file.props["title"] = (
            f"MCAP file to write, in {folder}; a name that you leave as it is gets the time at "
            f"which Record is pressed"
        )
        with ui.row().classes("us-session-row"):
            self._record = ui.button("Record", icon="fiber_manual_record", on_click=self._begin)
            self._record.props("no-caps dense")
            self._record.props["title"] = "Record all topics to the file"
            self._stop = ui.button("Stop", icon="stop", on_click=self._end)
            self._stop.props("no-caps dense")
            self._stop.props["title"] = "End the recording; it is complete then"
            self._recorded = ui.label().classes("us-quiet").props('role="status"')
        self._note = ui.label().classes("us-quiet").props('role="status"')

    def _replaying(self) -> None:
        ui.label("Replay").classes("us-cases-title")
        self._bag = ui.select(
            {}, label="recording or path", new_value_mode="add", key_generator=self._file_of
        )
        self._bag.props("dense outlined").classes("us-wide-field")
        self._bag.props["title"] = (
            "Bags in the folder that us-sim runs in, in that of recordings, and those that came "
            "with it; or type the path of another one and press Enter"
        )
        with ui.element("div") as self._kind_told:  # also told while the choice is disabled
            self._kind = ui.toggle(KINDS, value="path").props("no-caps dense")
        with ui.row().classes("us-session-row"):
            self._play = ui.button(icon="play_arrow", on_click=self._play_or_pause)
            self._play.props('dense aria-label="Play or pause" title="Play, pause, go on"')
            self._close = ui.button(icon="stop", on_click=lambda: self._ask(replay=""))
            self._close.props('dense aria-label="End replay" title="End the replay"')
            self._rate = ui.select(RATES, value=1.0, label="speed")
            self._rate.on_value_change(lambda event: self._change(replay_rate=float(event.value)))
            self._rate.props('dense outlined title="Speed factor"').classes("us-session-rate")
            self._loop = ui.switch("loop", value=False)
            self._loop.on_value_change(lambda event: self._change(replay_loop=bool(event.value)))
            self._loop.props["title"] = "Begin again at the end"
        self._time = ui.slider(min=0.0, max=1.0, step=0.01, value=0.0)
        self._time.props('aria-label="Time in the replay, s" title="Time in the replay, s"')
        self._time.on("update:model-value", self._drag)
        self._time.on("change", self._seek)
        self._where = ui.label().classes("us-quiet").props('role="status"')
        for control in (self._file, self._record, self._bag, self._play, self._rate, self._loop):
            enable_control(control)

    def _refresh(self) -> None:
        board, state = self._board, self._board.state
        self._absent.set_visibility(not state.is_there)
        self._all.set_visibility(state.is_there)
        self._problem.set_text(state.problem)
        self._problem.set_visibility(bool(state.problem))
        if state.record != self._shown_record:
            self._shown_record = state.record
            if state.record:
                self._file.set_value(PurePath(state.record).name)
            else:
                self._propose()
        enable_control(self._file, not state.record)
        enable_control(self._record, not state.record and state.replay_as == "path")
        enable_control(self._stop, bool(state.record))
        size, is_short = describe_recording(state) if state.is_recording else ("", False)
        activity = "recording to" if state.is_recording else f"{state.record_state}:"
        self._recorded.set_text(f"{activity} {state.record}{size}" if state.record else "")
        self._recorded.classes(**{"add" if is_short else "remove": "us-wrong"})
        self._note.set_text(state.record_note)
        self._note.set_visibility(bool(state.record_note))
        offered = {file: name for name, file in board.bags.items()}
        for file in filter(None, (self._bag.value, state.replay)):
            offered.setdefault(file, file)
        if offered != self._bag.options:
            self._bag.set_options(offered)
        self._follow(state)

    def _follow(self, state: SessionState) -> None:
        """Show the state of the replay, also after changes from elsewhere."""
        plays = bool(state.replay)
        is_running = plays and state.is_playing
        self._play.set_icon("pause" if is_running else "play_arrow")
        for control in (self._close, self._time):
            enable_control(control, plays)
        enable_control(self._kind, not plays)
        fixed = "While something is replayed this cannot be changed: end the replay first"
        self._kind_told.props["title"] = fixed if plays else KINDS_TOLD
        end = round(state.duration, 2)
        if end not in (0.0, self._time.props["max"]):
            self._time.props["max"] = end
        is_settled = not self._asking and time.monotonic() - self._answered > SETTLE_S
        if is_settled and not self._is_pointing:
            self._sought = None
        if self._sought is None:
            self._time.set_value(min(state.position, state.duration) if plays else 0.0)
        held = ", paused when it is ready" if state.is_starting and state.replay_paused else ""
        place = f"{state.position:.1f} of {state.duration:.1f} s, {state.replay_state}{held}"
        self._where.set_text(place if plays else "nothing is replayed")
        if not is_settled:
            return
        self._is_following = True
        try:
            if plays:
                self._bag.set_value(state.replay)
                self._kind.set_value(state.replay_as)
            self._loop.set_value(state.replay_loop)
            if state.replay_rate in RATES:
                self._rate.set_value(state.replay_rate)
        finally:
            self._is_following = False

    def _propose(self) -> None:
        self._proposed = _propose_name()
        self._file.set_value(self._proposed)

    def _file_of(self, typed: str) -> str:
        """Return the file of a listed bag's name; any other text is a path."""
        return self._board.bags.get(typed.strip(), typed.strip())

    async def _begin(self) -> None:
        if self._file.value == self._proposed:
            self._propose()
        await self._ask(record=self._file.value.strip())

    async def _end(self) -> None:
        file = self._board.state.record
        if await self._ask(record=""):
            ui.notify(f"recorded to {file}", type="positive")

    async def _play_or_pause(self) -> None:
        state = self._board.state
        chosen = self._bag.value
        if state.replay and chosen in (state.replay, None):
            if state.replay_state == "finished":
                await self._ask(replay_time=0.0, replay_paused=False)
            else:
                await self._ask(replay_paused=state.is_playing)
        elif not chosen:
            ui.notify("choose a recording or a path first", type="info")
        else:
            await self._ask(
                replay=chosen,
                replay_as=self._kind.value,
                replay_paused=False,
                replay_loop=self._loop.value,
                replay_rate=float(self._rate.value),
            )

    def _change(self, **values: object) -> Awaitable[bool] | None:
        """Ask for a change by a person; ignore one by `_follow`."""
        return None if self._is_following else self._ask(**values)

    def _drag(self, event: Any) -> None:
        """Show the time that a person points at, not the replay's, until the button is up."""
        self._sought, self._is_pointing = float(event.args), True

    async def _seek(self, event: Any) -> None:
        self._is_pointing = False
        await self._ask(replay_time=float(event.args) if self._sought is None else self._sought)

    async def _ask(self, **values: object) -> bool:
        """Set parameters of ``session_control``; return whether they were taken."""
        self._asking += 1
        try:
            refusal = await ask_session(self._board, **values)
        finally:
            self._asking -= 1
            self._answered = time.monotonic()
        return not notify_refusal(refusal)


def describe_recording(state: SessionState) -> tuple[str, bool]:
    """Describe length, size and room of a recording; return also whether the room is short.

    >>> state = SessionState(record_seconds=72.0, record_bytes=3.6e8, record_room_bytes=9e9)
    >>> describe_recording(state)
    (': 1:12 min, 360 MB, room for 30 min', False)
    """
    seconds, size, room = state.record_seconds, state.record_bytes, state.record_room_bytes
    if not room:
        return "", False
    minutes, rest = divmod(int(seconds), 60)
    shown = f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
    text = f": {minutes}:{rest:02} min, {shown}"
    if not size or seconds < 5.0:  # the rate is not known well enough
        return f"{text}, room for {room / 1e9:.1f} GB", False
    left = room / size * seconds / 60.0
    room_for = f"{left / 60:.0f} h" if left > 120 else f"{left:.0f} min"
    return f"{text}, room for {room_for}", left < 10.0


def _propose_name() -> str:
    return f"session_{datetime.now():%Y%m%d_%H%M%S}.mcap"
