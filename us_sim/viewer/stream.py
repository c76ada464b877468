"""The websocket of one page: packets of the streams it watches, and its commands."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import Callable
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from us_sim.viewer.feed import Feed
from us_sim.viewer.simulator import Simulator

_LONGEST = 65536
"""Characters of a page's message."""
_numbers = itertools.count(1)


class PageStream:
    """What one page watches, and what of it is due.

    A page says what it watches and then, for each stream, when it has drawn what came: so the
    newest is sent as soon as the page is ready, and a slow page gets fewer, not older ones.

    Args:
        simulator: whose feeds and commands.
        wake: called, from any thread, when something may be due.
    """

    def __init__(self, simulator: Simulator, wake: Callable[[], None]) -> None:
        self.number = next(_numbers)
        self._simulator, self._wake = simulator, wake
        self._watched: dict[str, Feed] = {}
        self._ready: set[str] = set()
        self._sent: dict[str, int] = {}
        self._earliest: dict[str, float] = {}  # s, when the next may be sent

    def take(self, text: str) -> str | None:
        """Do what the page says; what is wrong with it, for a person, or None."""
        try:
            message = json.loads(text) if len(text) <= _LONGEST else None
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict):
            return "what the page sent is no JSON object: load the page again"
        for key, value in message.items():
            wrong = self._take(key, value)
            if wrong:
                return wrong
        return None

    def _take(self, key: str, value: Any) -> str | None:
        if key == "watch" and isinstance(value, list):
            self.watch([kind for kind in value if isinstance(kind, str)])
        elif key == "next" and isinstance(value, str):
            self._ready.add(value)
            self._wake()
        elif key in self._simulator.commands:
            return self._simulator.commands[key](value, self.number)
        else:
            return f"the page sent {key!r}, which the viewer does not know: load the page again"
        return None

    def watch(self, kinds: list[str]) -> None:
        """Watch these, and no others; kinds that are not known may come later."""
        for kind in self._watched.keys() - set(kinds):
            self._watched.pop(kind).unwatch(self._wake)
        for kind in kinds:
            feed = self._simulator.feeds.get(kind)
            if feed is not None and kind not in self._watched:
                self._watched[kind] = feed
                self._ready.add(kind)
                self._sent[kind] = 0
                feed.watch(self._wake)
        self._wake()

    def due(self, now: float) -> tuple[list[bytes], float | None]:
        """What is to be sent now, encoded.

        Args:
            now: s, of a clock that is never set back.

        Returns:
            It, and s until more may be due that is there already; None where nothing is.
        """
        packets, later = [], None
        for kind, feed in self._watched.items():
            if kind not in self._ready or feed.sequence == self._sent[kind]:
                continue
            wait = self._earliest.get(kind, now) - now
            if wait > 0:
                later = wait if later is None else min(later, wait)
                continue
            packet = feed.newest()
            self._sent[kind] = feed.sequence if packet is None else packet.sequence
            if packet is not None:
                self._ready.discard(kind)
                self._earliest[kind] = self._next_time(kind, now)
                packets.append(packet.encoded)
        return packets, later

    def _next_time(self, kind: str, now: float) -> float:
        """When the next one may be sent: on the beat of the rate, and not sooner after a rest."""
        rate = self._watched[kind].rate
        if not rate:
            return now
        return max(self._earliest.get(kind, now) + 1.0 / rate, now)

    def close(self) -> None:
        """The page has gone."""
        self.watch([])


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
        page.close()
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
