"""The one page: header, 3D scene, image, and panels that can be opened; and the application."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from pathlib import Path, PurePath
from typing import Any

from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.concurrency import run_in_threadpool
from fastapi.staticfiles import StaticFiles
from nicegui import app as nicegui_app
from nicegui import ui

from us_sim.errors import UsSimError
from us_sim.viewer.export import LARGEST, exported, frames_of
from us_sim.viewer.modes import build_modes
from us_sim.viewer.panels.nodes import build_image, build_plots, build_status, build_tissue
from us_sim.viewer.panels.session import build_cases, build_session
from us_sim.viewer.session import SessionState
from us_sim.viewer.stream import PageStream, Simulator


def words_of(state: SessionState) -> tuple[str, str]:
    """The scene's name, and what is to be known of it; the second is often nothing.

    >>> words_of(SessionState(is_there=True, scene="upper_arm", state="running"))
    ('upper arm', '')
    >>> words_of(SessionState(is_there=True, scene="upper_arm", state="starting", fraction=0.4))
    ('upper arm', 'starting, 40 %')
    >>> replay = {"replay": "/home/a/press.mcap", "replay_state": "finished"}
    >>> words_of(SessionState(is_there=True, scene="upper_arm", record="/home/a/b.mcap", **replay))
    ('upper arm', 'recording b.mcap · replay of press.mcap: finished')
    """
    name = state.scene.replace("_", " ")
    if state.is_busy:
        return name, f"{state.state}, {100 * state.fraction:.0f} %"
    parts = [f"recording {PurePath(state.record).name}"] if state.record else []
    if state.replay:
        parts.append(f"replay of {PurePath(state.replay).name}: {state.replay_state}")
    return name, " · ".join(filter(None, parts))


def build_headline(simulator: Simulator) -> None:
    """Make it inside the header."""
    board, nodes = simulator.session, simulator.status
    name = ui.label().classes("us-scene-name").props('id="us-scene"')
    words = ui.label().classes("us-headline").props('role="status"')
    problem = ui.label().classes("us-headline us-wrong").props('role="alert"')

    def refresh() -> None:
        scene, told = words_of(board.state)
        name.set_text(scene)
        if name.props.get("data-scene") != board.state.scene:
            name.props["data-scene"] = board.state.scene  # as the headers of images say it
            name.update()
        known = (each.values.get("preparing", "") for each in nodes.nodes(time.monotonic()))
        words.set_text(" · ".join(filter(None, (*known, told))))
        problem.set_text(board.state.problem)

    board.watch()
    nodes.watch(pages=1)
    ui.context.client.on_delete(board.unwatch)
    ui.context.client.on_delete(lambda: nodes.watch(pages=-1))
    ui.timer(0.5, refresh)


_HEAD = """<link rel="stylesheet" href="/us_sim/assets/viewer.css">
<link rel="stylesheet" href="/us_sim/assets/panels.css">
<link rel="stylesheet" href="/us_sim/assets/session.css">"""


def _status(simulator: Simulator) -> None:
    build_status(simulator)
    build_plots(simulator)


PANELS = [
    ("Image", "contrast", "The scanner's console: depth, gain, focus and more", build_image),
    ("Tissue", "layers", "Method, materials, skin and tracker", build_tissue),
    ("Cases", "collections", "Scenes and cases to load", build_cases),
    ("Session", "radio_button_checked", "Record, and replay recordings", build_session),
    ("Status", "monitor_heart", "How every node is, and plots of the last minute", _status),
]
"""Name, icon of Material's, title, and the function that fills the tab."""


def build_page(simulator: Simulator) -> None:
    """Make the page for one browser."""
    ui.add_head_html(_HEAD)
    ui.add_body_html('<script type="module" src="/us_sim/assets/main.js"></script>')
    ui.colors(primary="#4fb3bf", dark="#171b1f", dark_page="#0e1113", negative="#e5735c")
    ui.query(".nicegui-content").classes("us-content")
    with ui.header(wrap=False).classes("us-header"):
        ui.label("us_sim").classes("us-brand").props("role=heading aria-level=1")
        build_headline(simulator)
        ui.space()
        _block("readout")
        button = ui.button(icon="tune").props("flat round dense id=us-panels")
    with ui.element("div").classes("us-main"):  # the page's <main> is Quasar's
        with _section("us-left", "Patient in 3D"):
            _block("scene")
            _block("hand")
        with _section("us-right", "Ultrasound"):
            build_modes(simulator)
            _block("ultrasound")
            _block("strips")
            _block("image-tools")
        with _section("us-drawer", "Panels") as drawer:
            _panels(simulator)
    drawer.set_visibility(False)
    button.props["title"] = "Panels: image, tissue, cases, session, status"
    button.props["aria-label"] = "Panels"
    button.props["aria-expanded"] = "false"

    def toggle() -> None:
        drawer.set_visibility(not drawer.visible)
        button.props["aria-expanded"] = str(drawer.visible).lower()

    button.on_click(toggle)


def _block(name: str) -> None:
    ui.element("div").props["id"] = name


def _section(name: str, label: str) -> ui.element:
    """A part of the page that assistive technology lists by its label."""
    section = ui.element("section")
    section.classes.append(name)
    section.props["aria-label"] = label
    return section


def _panels(simulator: Simulator) -> None:
    with ui.tabs().props("dense no-caps").classes("us-tabs") as tabs:
        for name, icon, title, _ in PANELS:
            ui.tab(name, icon=icon).props["title"] = title
    with ui.tab_panels(tabs, value=PANELS[0][0]).classes("us-panels"):
        for name, _, _, build in PANELS:
            with ui.tab_panel(name):
                build(simulator)


ASSETS = Path(__file__).parent / "assets"


def application(simulator: Simulator) -> Any:
    """The ASGI application of one viewer; a process has one."""
    # It warns of every path that is not there, as it was sent, with what a terminal obeys.
    logging.getLogger("nicegui").setLevel(logging.ERROR)
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    app.mount("/us_sim/assets", StaticFiles(directory=ASSETS))

    @app.websocket("/us_sim/stream")
    async def stream(websocket: WebSocket) -> None:
        await serve_page(websocket, simulator)

    @app.post("/us_sim/export/{kind}")
    async def export(kind: str, request: Request) -> Response:
        message = bytearray()
        async for chunk in request.stream():
            message += chunk
            if len(message) > LARGEST:
                return Response("that is too much to be saved: save less", 413)
        try:
            frames = frames_of(bytes(message))
            made = await run_in_threadpool(exported, kind, frames)
        except UsSimError as error:
            return Response(str(error), 400, media_type="text/plain")
        return Response(made, media_type="application/octet-stream")

    @ui.page("/")
    def page() -> None:
        build_page(simulator)

    # Its bar above the page would say nothing that a person waits for.
    nicegui_app.config.quasar_config["loadingBar"]["skipHijack"] = True
    ui.run_with(
        app,
        language="en-US",
        title="us_sim",
        dark=True,
        tailwind=False,  # a compiler in the page, which nothing here needs
        gzip_middleware_factory=None,
        binding_refresh_interval=None,
        show_welcome_message=False,
        favicon=ASSETS / "probe.svg",
    )
    return app


async def serve_page(websocket: WebSocket, simulator: Simulator) -> None:
    """Stay with one page until it goes."""
    await websocket.accept()
    loop = asyncio.get_running_loop()
    awake = asyncio.Event()

    def wake() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(awake.set)

    page = PageStream(simulator, wake)
    sending = asyncio.ensure_future(_send(websocket, page, awake))
    try:
        while True:
            wrong = page.take(await websocket.receive_text())
            if wrong:
                await websocket.send_text(json.dumps({"problem": wrong}))
    except (WebSocketDisconnect, RuntimeError, KeyError):
        pass  # it has gone, or sends bytes, which no page does
    finally:
        sending.cancel()
        page.watch([])
        for command in simulator.leaving:
            command(page.number)


async def _send(websocket: WebSocket, page: PageStream, awake: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()
    later: float | None = None
    while True:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(awake.wait(), later)
        awake.clear()
        packets, later = page.due(loop.time())
        try:
            for packet in packets:
                await websocket.send_bytes(packet)
        except (WebSocketDisconnect, RuntimeError):
            return
