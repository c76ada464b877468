"""The page: header, 3D scene, image with its modes and strips, panels; and its application."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from typing import Any

from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.staticfiles import StaticFiles
from nicegui import app as nicegui_app
from nicegui import ui

from us_sim.errors import UsSimError
from us_sim.slicing.settings import OVERLAYS, STRIPS
from us_sim.viewer.export import LARGEST, decode_frames, encode_video
from us_sim.viewer.panels.asking import find_refusal, notify_refusal, set_parameter
from us_sim.viewer.panels.exercise import ExercisePanel
from us_sim.viewer.panels.nodes import TISSUE, build_image, build_status, build_tissue
from us_sim.viewer.panels.session import CasesPanel, SessionPanel
from us_sim.viewer.parameters import ParameterKind
from us_sim.viewer.score import get_score, is_blind
from us_sim.viewer.session import SessionState
from us_sim.viewer.status import PageCounter
from us_sim.viewer.stream import PageSources, PageStream

NODE, OVERLAY, FLIP, BESIDE = "slice_interpolator", "overlay", "flip", "beside"
MODES = {
    "b-mode": ("B-mode", "The image as it is"),
    "none": ("Outlines", "With the outlines and names of structures, and marked when it is old"),
    **{name: mode[:2] for name, mode in OVERLAYS.items()},
}
"""Label and title by mode: the plain image, then the values of the parameter ``overlay``."""
SWITCHES = {
    BESIDE: ("Beside", "The B-mode image beside the one with outlines or colours, on all pages"),
    FLIP: (
        "Flip",
        "Exchange left and right, on all pages; the dot is at the side of the probe's mark",
    ),
}
"""Label and title by parameter that is on or off."""
_CONTACT = {
    "none": "No contact: press the probe onto the skin",
    "poor": "Poor contact: press more, or tilt less",
}
_NO_FLOW = {
    "no_contact": "no contact there: press more, or tilt less",
    "no_vessel": "no vessel with a flow there: drag it over one",
    "no_flow": "the vessel is closed: press less",
    "across_flow": "the beams cross the flow at a right angle: tilt the probe, or steer the beams",
    "too_slow": "the flow is slower than the wall filter lets through",
}
_UNMOVED = 1e-5  # m, or part of the face: a smaller drag does not move a place


class ModeBar:
    """The bar of the image's modes, strips and switches."""

    def __init__(self, sources: PageSources) -> None:
        self._sources, self._node = sources, sources.nodes.get_node(NODE)
        self._mode = "b-mode"
        self._buttons: dict[str, ui.button] = {}
        self._strips: dict[str, bool] = dict.fromkeys(STRIPS, False)
        self._places: list[dict[str, Any]] = []
        with ui.row().classes("us-modes").props('role="toolbar" aria-label="Image modes"') as bar:
            for mode, (label, text) in MODES.items():
                title = text if mode == "b-mode" else find_refusal() or text
                self._buttons[mode] = _button(label, title, lambda mode=mode: self._choose(mode))
            ui.element("span").classes("us-gap")
            for kind, (label, title, _) in STRIPS.items():
                self._buttons[kind] = _button(label, title, lambda kind=kind: self._toggle(kind))
            for name, (label, text) in SWITCHES.items():
                title = find_refusal() or text
                self._buttons[name] = _button(label, title, lambda name=name: self._switch(name))
        bar.on("us-place", lambda event: self._move(event.args.get("detail")), ["detail"])
        self._mark()
        self._remarks: list[str] = []
        _watch_while_connected(self._node, sources.status)
        ui.timer(0.3, self._refresh)

    async def _choose(self, mode: str) -> None:
        if mode in ("b-mode", self._overlay) or await self._set(OVERLAY, mode):
            self._show(mode)

    async def _switch(self, name: str) -> None:
        is_on = not self._is_on(name)
        if await self._set(name, is_on) and name == BESIDE and is_on and self._mode == "b-mode":
            await self._choose("none")
        self._mark()

    async def _set(self, name: str, value: object) -> bool:
        """Set a parameter of the node; return whether the node took the value."""
        return not notify_refusal(await set_parameter(self._node, name, value))

    @property
    def _overlay(self) -> Any:
        parameter = self._node.parameters.get(OVERLAY)
        return parameter.raw if parameter else None

    def _is_on(self, name: str) -> bool:
        parameter = self._node.parameters.get(name)
        return parameter is not None and bool(parameter.raw)

    def _show(self, mode: str) -> None:
        self._mode = mode
        kind = "b-mode" if mode == "b-mode" else "annotated"
        _call("image.js", "setMode", kind, MODES[mode][0])
        self._mark()

    def _toggle(self, kind: str) -> None:
        self._strips[kind] = not self._strips[kind]
        _call("strips.js", "showStrip", kind, self._strips[kind])
        self._mark()

    def _refresh(self) -> None:
        """Show changes from elsewhere, and the node's remarks on its images."""
        remarks = self._list_remarks()
        if remarks != self._remarks:
            self._remarks = remarks
            _call("image.js", "setRemarks", remarks)
        places = list(self._list_places())
        if places != self._places:
            self._places = places
            _call("image_tools/places.js", "setPlaces", places)
        known = self._overlay
        if self._mode != "b-mode" and known in MODES and known != self._mode:
            self._show(known)
        hides = is_blind(get_score(self._sources))
        if hides and self._mode != "b-mode":
            self._show("b-mode")
        for name in (*MODES, BESIDE):
            self._buttons[name].set_visibility(not hides or name == "b-mode")
        for name in (*MODES, *SWITCHES):
            self._buttons[name].set_enabled(not find_refusal() or name in ("b-mode", known))
        self._mark()

    def _list_remarks(self) -> list[str]:
        """Return the reasons why the images show little, for a person."""
        status = self._sources.status.find_node(NODE, time.monotonic())
        values = status.values if status else {}
        remarks = [_CONTACT.get(values.get("contact", ""), "")]
        tissue = self._sources.status.find_node(TISSUE, time.monotonic())
        force = (tissue.read_number("force") if tissue else None) or 0.0
        if force > 20.0:  # N; sonographers press with some 5 to 10
            remarks.append(f"Too much force: {force:.0f} N")
        if tissue and tissue.values.get("problem") == "inside out":
            remarks.append("Tissue is inside out: press less, or choose another method")
        if self._mode == "velocity":
            remarks.append(_explain_no_flow("No colour", values.get("no_colour", ""), values))
        if self._strips["spectrum"]:
            remarks.append(_explain_no_flow("No spectrum", values.get("no_spectrum", ""), values))
        return [remark for remark in remarks if remark]

    def _read_number(self, name: str) -> float | None:
        """Return a parameter of the node in SI units; None if it is no number or has no value."""
        parameter = self._node.parameters.get(name)
        if parameter is None or parameter.kind is not ParameterKind.NUMBER:
            return None
        return float(parameter.raw) if parameter.value is not None else None

    def _list_places(self) -> Iterator[dict[str, Any]]:
        """Yield the colour box, the gate and the line, which a person can drag; m and rad."""
        deepest = self._read_number("depth")
        if deepest is None:
            return
        defaults = {"lateral": 0.0, "depth": 0.5 * deepest, "steering": 0.0, "width": 0.0}
        defaults |= {"height": 0.5 * deepest, "size": 0.0}
        shown = {"colour": self._mode == "velocity", **self._strips}
        for kind, on in shown.items():
            if on and self._read_number(f"{kind}.lateral") is not None:
                known = {
                    key: self._read_number(f"{kind}.{key}") or default
                    for key, default in defaults.items()
                }
                yield {"kind": kind, "deepest": deepest, **known}

    async def _move(self, detail: Any) -> None:
        """Move the box, the gate or the line as a person has dragged it."""
        place = detail if isinstance(detail, dict) else {}
        kind = place.get("kind")
        for name in ("lateral", "depth"):
            parameter = self._node.parameters.get(f"{kind}.{name}")
            value = place.get(name)
            if parameter is None or kind not in ("colour", *STRIPS):
                continue
            if not isinstance(value, int | float) or abs(value - parameter.raw) < _UNMOVED:
                continue
            if not await self._set(parameter.name, value / parameter.size):
                return

    def _mark(self) -> None:
        shown = {**self._strips, self._mode: True, **{name: self._is_on(name) for name in SWITCHES}}
        for name, button in self._buttons.items():
            pressed = str(shown.get(name, False)).lower()
            if button.props.get("aria-pressed") != pressed:
                button.props["aria-pressed"] = pressed


def _call(module: str, function: str, *arguments: Any) -> None:
    """Call a function of one of the page's modules."""
    listed = ", ".join(map(json.dumps, arguments))
    ui.run_javascript(f"import('/us_sim/assets/{module}').then(m => m.{function}({listed}))")


def _button(label: str, title: str, on_click: Any) -> ui.button:
    button = ui.button(label, color=None, on_click=on_click).props("flat dense no-caps")
    button.props["title"] = title
    return button


def _explain_no_flow(what: str, reason: str, values: Mapping[str, str]) -> str:
    """Explain why no flow is seen; "" if there is no reason or the whole image has it."""
    if reason not in _NO_FLOW or (reason == "no_contact" and values.get("contact") != "good"):
        return ""
    return f"{what}: {_NO_FLOW[reason]}"


def describe_scene(state: SessionState) -> tuple[str, str]:
    """Return the scene's name and a remark on its state, often empty.

    >>> describe_scene(SessionState(scene="upper_arm", state="starting", fraction=0.4))
    ('upper arm', 'starting, 40 %')
    >>> replay = {"replay": "/home/a/press.mcap", "replay_state": "finished"}
    >>> record = {"record": "/home/a/b.mcap", "record_state": "recording"}
    >>> describe_scene(SessionState(scene="upper_arm", **record, **replay))
    ('upper arm', 'recording b.mcap · replay of press.mcap: finished')
    """
    name = state.scene.replace("_", " ")
    if state.is_busy:
        return name, f"{state.state}, {100 * state.fraction:.0f} %"
    activity = "recording" if state.is_recording else f"recorder {state.record_state}:"
    parts = [f"{activity} {PurePath(state.record).name}"] if state.record else []
    if state.replay:
        parts.append(f"replay of {PurePath(state.replay).name}: {state.replay_state}")
    return name, " · ".join(filter(None, parts))


def build_headline(sources: PageSources) -> None:
    """Build the scene's name, its state and its problem inside the header."""
    board, nodes = sources.session, sources.status
    name = ui.label().classes("us-scene-name").props('id="us-scene"')
    words = ui.label().classes("us-headline").props('role="status"')
    problem = ui.label().classes("us-headline us-wrong").props('role="alert"')

    def refresh() -> None:
        scene, remark = describe_scene(board.state)
        name.set_text(scene)
        if name.props.get("data-scene") != board.state.scene:
            name.props["data-scene"] = board.state.scene  # as the headers of images say it
            name.update()
        known = (each.values.get("preparing", "") for each in nodes.list_nodes(time.monotonic()))
        words.set_text(" · ".join(filter(None, (*known, remark))))
        problem.set_text(board.state.problem)

    _watch_while_connected(board, nodes)
    ui.timer(0.5, refresh)


def _watch_while_connected(*shown: PageCounter) -> None:
    """Count the page while its browser is connected; a browser may come and go several times."""
    connections = 0

    def change(by: int) -> None:
        nonlocal connections
        before, connections = connections, connections + by
        if bool(before) != bool(connections):
            for each in shown:
                (each.remove_page if before else each.add_page)()

    ui.context.client.on_connect(lambda: change(1))
    ui.context.client.on_disconnect(lambda: change(-1))


_HEAD = """<link rel="stylesheet" href="/us_sim/assets/viewer.css">
<link rel="stylesheet" href="/us_sim/assets/panels.css">
<link rel="stylesheet" href="/us_sim/assets/session.css">"""


TISSUE_TAB = "Tissue"
PANELS = [
    ("Image", "contrast", "The scanner's console: depth, gain, focus and more", build_image),
    (TISSUE_TAB, "layers", "Method, materials, skin and tracker", build_tissue),
    ("Cases", "collections", "Scenes and cases to load", CasesPanel),
    ("Session", "radio_button_checked", "Record, and replay recordings", SessionPanel),
    ("Exercise", "school", "A task, what is done of it, and the score", ExercisePanel),
    ("Status", "monitor_heart", "How every node is", build_status),
]
"""Name, icon of Material's, title, and the function that fills the tab."""


def build_page(sources: PageSources) -> None:
    """Build the page for one browser."""
    ui.add_head_html(_HEAD)
    ui.add_body_html('<script type="module" src="/us_sim/assets/main.js"></script>')
    ui.colors(primary="#4fb3bf", dark="#171b1f", dark_page="#0e1113", negative="#e5735c")
    ui.query(".nicegui-content").classes("us-content")
    with ui.header(wrap=False).classes("us-header"):
        ui.label("us_sim").classes("us-brand").props("role=heading aria-level=1")
        build_headline(sources)
        ui.space()
        _block("readout")
        button = ui.button(icon="tune").props("flat round dense id=us-panels")
    with ui.element("div").classes("us-main"):  # the page's <main> is Quasar's
        with _section("us-left", "Patient in 3D"):
            _block("scene")
            _block("hand")
        with _section("us-right", "Ultrasound"):
            ModeBar(sources)
            _block("ultrasound")
            _block("strips")
            _block("image-tools")
        with _section("us-drawer", "Panels") as drawer:
            tabs, tissue = _build_panels(sources)
    drawer.set_visibility(False)
    button.props["title"] = "Panels: image, tissue, cases, session, exercise, status"
    button.props["aria-label"] = "Panels"
    button.props["aria-expanded"] = "false"

    def toggle() -> None:
        drawer.set_visibility(not drawer.visible)
        button.props["aria-expanded"] = str(drawer.visible).lower()

    def show_exercise() -> None:
        """Open the panel of an exercise once, if the window has room beside the 3D view."""
        if get_score(sources).get("steps"):
            asking.deactivate()
            tabs.set_value("Exercise")
            if not drawer.visible:
                open_it = "document.getElementById('us-panels').click()"
                ui.run_javascript(f"if (innerWidth > 939) {open_it}")

    def hide_truth() -> None:
        """Hide the panel that shows the truth while an exercise asks for it."""
        hides = is_blind(get_score(sources))
        tissue.set_visibility(not hides)
        if hides and tabs.value == TISSUE_TAB:
            tabs.set_value("Exercise")

    button.on_click(toggle)
    ui.timer(0.5, hide_truth)
    asking = ui.timer(0.5, show_exercise)


def _block(name: str) -> None:
    ui.element("div").props["id"] = name


def _section(name: str, label: str) -> ui.element:
    """Build a part of the page that assistive technology lists by its label."""
    section = ui.element("section")
    section.classes.append(name)
    section.props["aria-label"] = label
    return section


def _build_panels(sources: PageSources) -> tuple[ui.tabs, ui.tab]:
    """Build the panels; return their tabs, and the tissue's tab."""
    made = {}
    with ui.tabs().props("dense no-caps").classes("us-tabs") as tabs:
        for name, icon, title, _ in PANELS:
            made[name] = ui.tab(name, icon=icon)
            made[name].props["title"] = title
    with ui.tab_panels(tabs, value=PANELS[0][0]).classes("us-panels"):
        for name, _, _, build in PANELS:
            with ui.tab_panel(name):
                build(sources)
    return tabs, made[TISSUE_TAB]


ASSETS = Path(__file__).parent / "assets"


def make_application(sources: PageSources) -> Any:
    """Make the ASGI application of a viewer; a process can have one."""
    # It logs every unknown path as it was sent, with its control characters for a terminal.
    logging.getLogger("nicegui").setLevel(logging.ERROR)
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.mount("/us_sim/assets", StaticFiles(directory=ASSETS))

    @app.websocket("/us_sim/stream")
    async def stream(websocket: WebSocket) -> None:
        await serve_page(websocket, sources)

    @app.post("/us_sim/export")
    async def export(request: Request) -> Response:
        message = bytearray()
        async for chunk in request.stream():
            message += chunk
            if len(message) > LARGEST:
                return Response("that is too much to be saved: save less", 413)
        try:
            video = await run_in_threadpool(encode_video, decode_frames(bytes(message)))
        except UsSimError as error:
            return Response(str(error), 400, media_type="text/plain")
        return Response(video, media_type="video/mp4")

    @ui.page("/")
    def page() -> None:
        build_page(sources)

    # NiceGUI's progress bar above the page tells nothing that a person waits for.
    nicegui_app.config.quasar_config["loadingBar"]["skipHijack"] = True
    ui.run_with(
        app,
        language="en-US",
        title="us_sim",
        dark=True,
        tailwind=False,  # a compiler in the page, which is not needed
        gzip_middleware_factory=None,
        binding_refresh_interval=None,
        show_welcome_message=False,
        # A page on a busy computer misses heartbeats; a reload would close its panels.
        reconnect_timeout=30.0,
        favicon=ASSETS / "probe.svg",
    )
    return app


async def serve_page(websocket: WebSocket, sources: PageSources) -> None:
    """Serve one page's websocket until it closes."""
    await websocket.accept()
    loop = asyncio.get_running_loop()
    awake = asyncio.Event()

    def wake() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(awake.set)

    page = PageStream(sources, wake, only_watches="watch" in websocket.query_params)
    sending = asyncio.ensure_future(_send(websocket, page, awake))
    try:
        while True:
            problem = page.obey_message(await websocket.receive_text())
            if problem:
                await websocket.send_text(json.dumps({"problem": problem}))
    except (WebSocketDisconnect, RuntimeError, KeyError):
        pass  # the page has gone, or it sent bytes, which only a stranger does
    finally:
        sending.cancel()
        page.watch_kinds([])
        for command in sources.leaving:
            command(page.number)


async def _send(websocket: WebSocket, page: PageStream, awake: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()
    wait: float | None = None
    while True:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(awake.wait(), wait)
        awake.clear()
        packets, wait = page.collect_due(loop.time())
        try:
            for packet in packets:
                await websocket.send_bytes(packet)
        except (WebSocketDisconnect, RuntimeError):
            return
