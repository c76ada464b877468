"""The panel of exercises: their list, the task, its steps, and the result."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from nicegui import ui
from nicegui.element import Element

from us_sim.scene.listing import ListedScene
from us_sim.scoring.settings import ANSWERS, NO_ANSWER, NO_THROMBUS, STATES
from us_sim.viewer.panels.asking import (
    ask_session,
    enable_control,
    find_refusal,
    notify_refusal,
    set_parameter,
)
from us_sim.viewer.panels.controls import WhileShown
from us_sim.viewer.panels.session import ask_confirmation, ask_to_load
from us_sim.viewer.parameters import format_name
from us_sim.viewer.score import PICTURE, SCORE, get_score, is_blind
from us_sim.viewer.stream import Feed, PageSources

EVERY_S = 0.5  # between two refreshes of the panel
ANSWER_S = 30.0  # for a picture: one of an hour takes seconds, on a busy computer more
TITLE = "Exercise"
NOTHING = "No exercise is followed: choose one."
_LOOKS = {
    "done": ("Done", "check_circle"),
    "missed": ("Missed", "cancel"),
    "to do": ("To do", "radio_button_unchecked"),
}
"""Words and icons of Material's, by state of a step."""
_ALT = "The probe's way over the skin, with the force; force and areas of vessels over time"
_SCORER = "scorer"


class Hints(Element, component="hints.js"):
    """Tells a person what to do with the mouse at the moment."""


class ExercisePanel:
    """The panel of exercises; all pages show the same, so that a teacher sees the learner's."""

    def __init__(self, sources: PageSources) -> None:
        self._sources, self._board = sources, sources.session
        self._scorer = sources.nodes.get_node(_SCORER)
        self._only_watches = bool(find_refusal())
        self._watched: list[Feed] = []
        self._score: Mapping[str, Any] | None = None  # that is shown
        self._listed: tuple[object, ...] = ()  # exercises that are shown
        self._parts: dict[Element, Any] = {}  # content of the panel's parts as drawn
        self._picture = b""
        self._begun: str | None = None  # the attempt that is shown, by the time of its begin
        self._given: list[str] = []  # answers on its points that were clicked here
        self._seen: list[ui.label] = []  # what was seen of each step
        self._choices: dict[tuple[int, str], ui.button] = {}  # by step and answer
        with WhileShown(self._begin, self._end, EVERY_S, self._refresh):
            self._choice = ui.expansion("Exercises").classes("us-cases-more")
            with self._choice:
                self._list = ui.column().classes("us-steps")
            self._name = ui.label(TITLE).classes("us-heading")
            self._name.props('role="heading" aria-level="2"')
            self._about = ui.label().classes("us-note")
            self._hints = Hints()
            self._result = ui.label().classes("us-session-state").props('role="status"')
            self._changed = ui.label().classes("us-note")
            self._steps = ui.column().classes("us-steps")
            self._faults = ui.column().classes("us-steps us-session-problem")
            with ui.row() as self._buttons:
                _button("Begin anew", "Forget what was done so far", self._clear)
                self._after = [  # of which nothing is told before the end
                    _button("Show the result", "A picture of what was done so far", self._draw),
                    _button("Save the result", "Picture and numbers as a page to keep", self._save),
                ]
            self._plain = ui.grid(columns=2).classes("us-metrics")
            self._image = ui.image().classes("us-score-picture").props("no-spinner")
            self._image.props["alt"] = _ALT
            self._image.on("click", self._enlarge)
            with ui.expansion("More").classes("us-cases-more"):
                self._metrics = ui.grid(columns=2).classes("us-metrics")

    def _begin(self) -> None:
        feeds = self._sources.feeds
        self._watched = [feeds[kind] for kind in (SCORE, PICTURE) if kind in feeds]
        for feed in self._watched:
            feed.add_watcher(self._ignore_packet)
        self._board.add_page()
        self._scorer.add_page()

    def _end(self) -> None:
        for feed in self._watched:
            feed.remove_watcher(self._ignore_packet)
        self._board.remove_page()
        self._scorer.remove_page()

    def _ignore_packet(self) -> None:
        """Do nothing: the panel looks for packets twice a second."""

    def _get_picture(self) -> bytes:
        feed = self._sources.feeds.get(PICTURE)
        packet = feed.get_newest() if feed is not None else None
        return packet.payload if packet is not None else b""

    def _refresh(self) -> None:
        score = get_score(self._sources)
        if score != self._score:
            self._score = score
            self._show(score)
        exercises = [each for each in self._board.scenes if each.kind == "exercise"]
        listed = (*exercises, self._board.state.origin, self._board.state.is_busy)
        if listed != self._listed:
            self._listed = listed
            self._show_list(exercises)
        picture = self._get_picture() if score.get("name") else b""
        if picture != self._picture or self._image.visible != bool(picture):
            self._picture = picture
            self._image.set_source(_address(picture) if picture else "")
            self._image.set_visibility(bool(picture))

    def _show_list(self, exercises: Iterable[ListedScene]) -> None:
        state = self._board.state
        self._list.clear()
        with self._list:
            for number, each in enumerate(exercises, 1):
                is_loaded = state.origin.partition("#")[0] == each.origin
                button = ui.button(
                    f"{number}. {each.name}", on_click=lambda each=each: self._load(each)
                ).props("flat dense no-caps align=left")
                button.props["title"] = f"{each.description} In {each.region.replace('_', ' ')}"
                button.props["aria-current"] = str(is_loaded).lower()
                enable_control(button, state.is_there and not state.is_busy)

    async def _load(self, exercise: ListedScene) -> None:
        if await ask_to_load(self._sources, exercise):
            self._choice.close()

    def _show(self, score: Mapping[str, Any]) -> None:
        name, steps = score.get("name", ""), score.get("steps", [])
        self._name.set_text(name or TITLE)
        self._about.set_text(score["description"] if name else NOTHING)
        done = [step["state"] == "done" for step in steps]
        seconds = next(iter(score.get("plain", {}).values()), "-")
        clock = f", {seconds} s" if seconds != "-" else ""
        state = STATES[score.get("state", "to lift")]
        is_asked = is_blind(score) and score["state"] == "running"
        asks = is_asked and not self._only_watches
        dots = max((len(step.get("target", ())) for step in steps), default=0)
        self._hints.props.update(state=score.get("state", ""), dots=dots)
        self._hints.set_visibility(bool(steps) and not self._only_watches)
        about = score.get("about", {})
        changed = about.get("changed", "")
        self._changed.set_text(f"Changed, and told in the result: {_name_changed(changed)}")
        self._changed.set_visibility(bool(changed))
        count = "" if is_blind(score) else f": {sum(done)} of {len(done)} done"
        self._result.set_text(f"{state}{count}{clock}" if done else "")
        self._buttons.set_visibility(bool(name) and not self._only_watches)
        for button in self._after:
            button.set_visibility(not is_blind(score))
        if about.get("begun") != self._begun:
            self._begun, self._given = about.get("begun"), []
        parts: list[tuple[Element, Callable[..., None], tuple[Any, ...]]] = [
            (self._steps, self._draw_steps, ([(s["what"], s["state"]) for s in steps], asks)),
            (self._faults, _draw_faults, (score.get("faults", []),)),
            (self._plain, _draw_metrics, (score.get("plain", {}),)),
            (self._metrics, _draw_metrics, (score.get("metrics", {}),)),
        ]
        for part, draw, shown in parts:
            if shown != self._parts.get(part):  # a button must not vanish under a click
                part.clear()
                with part:
                    draw(*shown)
                self._parts[part] = shown
        self._update_steps(steps)

    def _find_answers(self) -> list[str]:
        """Return the answers on points so far: those clicked here, or those that the scorer has."""
        known = self._scorer.parameters.get("answers")
        return [*self._given] or [each for each in (known.raw if known is not None else ()) if each]

    def _draw_steps(self, steps: Sequence[tuple[str, str]], asks: bool) -> None:
        """Draw what is to be done, with its state, and the buttons to answer."""
        self._seen, self._choices = [], {}
        for number, (what, state) in enumerate(steps):
            with ui.row(wrap=False).classes("us-step") as row:
                row.props["data-state"] = state
                ui.icon(_LOOKS[state][1])
                self._seen.append(ui.label())
            if asks and state == "to do":
                with ui.row().classes("us-answers"):
                    self._ask(number, what, len(steps))

    def _ask(self, number: int, what: str, count: int) -> None:
        """Build the buttons by which the learner answers on a point, or on the thrombus."""
        points = [f"{k + 1}" for k in range(count - 1)]
        is_last = number == len(points)
        for answer in (NO_THROMBUS, *points) if is_last else ANSWERS:
            label = f"at {answer}" if answer.isdigit() else answer
            button = ui.button(label).props("dense no-caps")
            button.on_click(lambda answer=answer: self._answer(number, answer, is_last))
            button.props["aria-label"] = f"{what}: {label}"
            self._choices[number, answer] = button

    def _update_steps(self, steps: Sequence[Mapping[str, Any]]) -> None:
        """Show what was seen and answered so far, with the same buttons."""
        for label, step in zip(self._seen, steps, strict=True):
            label.set_text(f"{_LOOKS[step['state']][0]}: {step['what']}, {step['seen']}")
        given = dict(enumerate(self._find_answers()))
        for (number, answer), button in self._choices.items():
            button.props["outline"] = answer != given.get(number)
            button.props["aria-pressed"] = str(answer == given.get(number)).lower()

    async def _answer(self, number: int, answer: str, is_last: bool) -> None:
        if is_last:
            refusal = await set_parameter(self._scorer, "thrombus", answer)
        else:
            answers = self._find_answers()
            answers += [NO_ANSWER] * (number + 1 - len(answers))
            answers[number] = answer
            self._given = answers  # the next click comes before the scorer has told of this one
            refusal = await set_parameter(self._scorer, "answers", answers)
            if refusal:
                self._given = []
        notify_refusal(refusal)

    async def _clear(self) -> None:
        score = self._score or {}
        if notify_refusal(find_refusal()):
            return
        sentence = f"It ends the attempt at {score.get('name', '')}."
        if score.get("state") == "running" and not await ask_confirmation("Begin anew", sentence):
            return
        if score.get("about", {}).get("feedback") == "afterwards":  # another arm: this one is known
            origin = self._board.state.origin.partition("#")[0]
            notify_refusal(await ask_session(self._board, scene=origin))
        else:
            self._sources.ask_scorer("clear")

    async def _draw(self) -> bool:
        """Have the scorer draw the picture anew; return whether it did."""
        if notify_refusal(find_refusal()):
            return False
        feed = self._sources.feeds[PICTURE]
        before = feed.sequence
        self._sources.ask_scorer("draw")
        for _ in range(int(ANSWER_S / 0.1)):
            if feed.sequence > before:
                return bool(self._get_picture())
            await asyncio.sleep(0.1)
        ui.notify("scorer has drawn nothing: is it still there?", type="warning")
        return False

    def _enlarge(self) -> None:
        with ui.dialog(value=True).props("maximized") as dialog, ui.card().classes("us-large"):
            dialog.props["aria-label"] = "The result"
            ui.image(_address(self._picture)).props("no-spinner").props["alt"] = _ALT
            ui.button("Close", on_click=dialog.close).props("no-caps")

    async def _save(self) -> None:
        from us_sim.scoring.result import render_page  # it brings scipy, which only this takes

        if await self._draw():
            now = datetime.now().strftime("%Y-%m-%d-%H-%M-%S")
            page = render_page(get_score(self._sources), self._get_picture())
            ui.download.content(page, f"us_sim-{now}.html", "text/html")


def _button(label: str, title: str, on_click: Any) -> ui.button:
    button = ui.button(label, on_click=on_click).props("flat dense no-caps")
    button.props["title"] = title
    return button


def _name_changed(changes: str) -> str:
    """Name the parameters in the scorer's list of changes, each once.

    >>> _name_changed("slice_interpolator.gain = 3.0 at 7 s; slice_interpolator.gain = 6.0 at 8 s")
    'gain'
    """
    settings = [change.partition(" = ")[0].partition(".")[2] for change in changes.split("; ")]
    return ", ".join(dict.fromkeys(map(format_name, settings)))


def _draw_faults(faults: Iterable[Mapping[str, str]]) -> None:
    for fault in faults:
        ui.label(f"{fault['seconds']} s: {fault['what']}")


def _draw_metrics(metrics: Mapping[str, str]) -> None:
    for label, value in metrics.items():
        ui.label(label).classes("us-quiet")
        ui.label(value)


def _address(picture: bytes) -> str:
    from us_sim.scoring.result import encode_picture

    return encode_picture(picture)
