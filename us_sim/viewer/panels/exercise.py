"""The panel of an exercise: the task, what is done of it, the metrics so far, and the result."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Iterable, Mapping
from datetime import datetime
from html import escape
from typing import Any

from nicegui import ui

from us_sim.viewer.panels.controls import WhileShown
from us_sim.viewer.score import PICTURE, SCORE
from us_sim.viewer.stream import Feed, Simulator

EVERY_S = 0.5
"""How often the panel is brought up to date."""
ANSWER_S = 30.0
"""For a picture to be drawn: of an hour it takes seconds, on a busy computer more."""
TITLE = "Exercise"
NOTHING = (
    "No exercise is followed: load a scene that has one, such as upper arm thrombosis, or start "
    "the node scorer."
)
_LOOKS = {
    "done": ("Done", "check_circle"),
    "missed": ("Missed", "cancel"),
    "to do": ("To do", "radio_button_unchecked"),
}
"""Words and icons of Material's, by states of steps."""
_ALT = "The probe's way over the skin, with the force; force and areas of vessels over time"


class ExercisePanel:
    """The panel of an exercise: every page shows the same, so that a teacher sees a learner's."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._watched: list[Feed] = []
        self._told: Mapping[str, Any] | None = None  # what is shown
        self._picture = b""
        with WhileShown(self._begin, self._end, EVERY_S, self._refresh):
            self._name = ui.label(TITLE).classes("us-heading")
            self._name.props('role="heading" aria-level="2"')
            self._about = ui.label().classes("us-note")
            self._result = ui.label().classes("us-session-state").props('role="status"')
            self._steps = ui.column().classes("us-steps")
            with ui.row() as self._buttons:
                for label, title, work in (
                    ("Begin anew", "Forget what was done so far", self._clear),
                    ("Show the result", "A picture of what was done so far", self._draw),
                    ("Save the result", "Picture and numbers as a page to keep", self._save),
                ):
                    button = ui.button(label, on_click=work).props("flat dense no-caps")
                    button.props["title"] = title
            self._image = ui.image().classes("us-score-picture").props("no-spinner")
            self._image.props["alt"] = _ALT
            with ui.expansion("Score so far").classes("us-cases-more"):
                self._metrics = ui.grid(columns=2).classes("us-metrics")

    def _begin(self) -> None:
        feeds = self._simulator.feeds
        self._watched = [feeds[kind] for kind in (SCORE, PICTURE) if kind in feeds]
        for feed in self._watched:
            feed.watch(self._changed)

    def _end(self) -> None:
        for feed in self._watched:
            feed.unwatch(self._changed)

    def _changed(self) -> None:
        """Nothing: the panel looks twice a second."""

    def _drawn(self) -> bytes:
        feed = self._simulator.feeds.get(PICTURE)
        packet = feed.newest() if feed is not None else None
        return packet.payload if packet is not None else b""

    def _refresh(self) -> None:
        told = told_score(self._simulator)
        if told != self._told:
            self._told = told
            self._show(told)
        picture = self._drawn() if told.get("name") else b""
        if picture != self._picture or self._image.visible != bool(picture):
            self._picture = picture
            self._image.set_source(_data(picture) if picture else "")
            self._image.set_visibility(bool(picture))

    def _show(self, told: Mapping[str, Any]) -> None:
        name, steps = told.get("name", ""), told.get("steps", [])
        self._name.set_text(name or TITLE)
        self._about.set_text(told["description"] if name else NOTHING)
        done = _done(steps)
        passed = "passed: " if all(done) else ""
        self._result.set_text(f"{passed}{sum(done)} of {len(done)} done" if done else "")
        self._buttons.set_visibility(bool(name))
        self._steps.clear()
        self._metrics.clear()
        with self._steps:
            for step in steps:
                word, icon = _LOOKS[step["state"]]
                with ui.row(wrap=False).classes("us-step") as row:
                    row.props["data-state"] = step["state"]
                    ui.icon(icon)
                    ui.label(f"{word}: {step['what']}, {step['seen']}")
        with self._metrics:
            for label, value in told.get("metrics", {}).items():
                ui.label(label).classes("us-quiet")
                ui.label(value)

    def _clear(self) -> None:
        self._simulator.ask_scorer("clear")

    async def _draw(self) -> bool:
        """Have the picture drawn anew; whether it was."""
        feed = self._simulator.feeds[PICTURE]
        before = feed.sequence
        self._simulator.ask_scorer("draw")
        for _ in range(int(ANSWER_S / 0.1)):
            if feed.sequence > before:
                return bool(self._drawn())
            await asyncio.sleep(0.1)
        ui.notify("scorer has drawn nothing: is it still there?", type="warning")
        return False

    async def _save(self) -> None:
        if await self._draw():
            now = datetime.now().strftime("%Y-%m-%d-%H-%M-%S")
            page = result_page(told_score(self._simulator), self._drawn(), now)
            ui.download.content(page, f"us_sim-{now}.html", "text/html")


def told_score(simulator: Simulator) -> Mapping[str, Any]:
    """The newest score of the scene that runs; empty where there is none."""
    feed, state = simulator.feeds.get(SCORE), simulator.session.state
    packet = feed.newest() if feed is not None else None
    is_other = packet is not None and state.is_there and packet.header["scene"] != state.scene
    return {} if packet is None or is_other else packet.header


def result_page(told: Mapping[str, Any], picture: bytes, when: str) -> str:
    """A page in one file, with steps, picture and metrics of a score as its stream tells it."""
    from us_sim.scoring.exercise import result_of  # it brings scipy, which only this takes

    steps = [(_LOOKS[s["state"]][0], s["what"], s["seen"]) for s in told.get("steps", [])]
    result = result_of(_done(told["steps"])) if steps else ""
    title = escape(told["name"])
    return (
        f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        "<style>body {font-family: sans-serif; max-width: 70em; margin: 2em auto} "
        "td {padding: 0 1em 0 0} img {max-width: 100%}</style>"
        f"<h1>{title}</h1><p>{escape(told['description'])}</p>"
        f"<p>us_sim, {escape(told['scene'])}, {when}, simulated</p><p>{result}</p>{_table(steps)}"
        f'<img src="{_data(picture)}" alt="{_ALT}">{_table(told["metrics"].items())}</html>'
    )


def _table(rows: Iterable[tuple[str, ...]]) -> str:
    cells = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def _data(picture: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture).decode()}"


def _done(steps: Iterable[Mapping[str, Any]]) -> list[bool]:
    return [step["state"] == "done" for step in steps]
