"""What the web server serves: the page, its own files, and the stream."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request, Response, WebSocket
from fastapi.concurrency import run_in_threadpool
from fastapi.staticfiles import StaticFiles
from nicegui import app as nicegui_app
from nicegui import ui

from us_sim.errors import UsSimError
from us_sim.viewer.export import LARGEST, exported, frames_of
from us_sim.viewer.page import build_page
from us_sim.viewer.simulator import Simulator
from us_sim.viewer.stream import serve_page

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
