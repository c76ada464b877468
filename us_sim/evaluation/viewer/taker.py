"""A page that takes what streams, as a browser would, and draws nothing; it may move the probe."""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from typing import Any

from us_sim.errors import UsSimError
from us_sim.viewer.stream import Packet

STREAMED = (
    "image",
    "skin_mesh",
    "skin",
    "structures_mesh",
    "structures",
    "probe",
    "hand",
)
"""What the page shows when it is opened."""
RATE = 60.0
"""Commands a second of a hand that moves."""
PRESS, PERIOD = 0.006, 2.0
"""m and s of the press that it repeats."""


class Taker:
    """One page, with a thread that takes and, if it moves the probe, one that asks.

    Args:
        address: of the viewer, as it was printed.
        by_hand: move the probe.

    Raises:
        UsSimError: it cannot be reached.
    """

    def __init__(self, address: str, *, by_hand: bool = False) -> None:
        try:
            from websockets.sync.client import connect
        except ImportError as error:
            raise UsSimError("this needs the viewer: pip install 'us_sim[viewer]'") from error
        self._stack = contextlib.ExitStack()
        host = address.partition("://")[2].partition("/")[0]
        try:
            self._socket = self._stack.enter_context(
                connect(f"ws://{host}/us_sim/stream", compression=None, max_size=2**26, max_queue=4)
            )
        except OSError as error:
            raise UsSimError(f"no viewer answers at {address} ({error})") from error
        self.images: list[tuple[int, int]] = []  # stamp and arrival, ns
        self.delays: list[float] = []  # ms from a command to the first image that contains it
        self.bytes = 0
        self._asked: dict[int, int] = {}  # ns, by number
        self._answered = 0
        self._source = f"taker {id(self)}"
        self._lock = threading.Lock()
        self._socket.send(json.dumps({"watch": list(STREAMED)}))
        self._open = True
        self._threads = [threading.Thread(target=self._take, daemon=True)]
        if by_hand:
            self._threads.append(threading.Thread(target=self._move, daemon=True))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Leave."""
        self._open = False
        self._stack.close()
        for thread in self._threads:
            thread.join(2.0)

    def _send(self, message: dict[str, Any]) -> None:
        with self._lock:
            self._socket.send(json.dumps(message))

    def _take(self) -> None:
        try:
            for data in self._socket:
                if isinstance(data, str):
                    continue
                now = time.time_ns()
                packet = Packet.decoded(data)
                self.bytes += len(data)
                if packet.kind == "image":
                    self._note(packet, now)
                self._send({"next": packet.kind})
        except Exception:
            if self._open:
                raise

    def _note(self, packet: Packet, now: int) -> None:
        self.images.append((int(packet.header["stamp"]), now))
        source, number = packet.header.get("command") or ("", 0)
        if source == self._source and number > self._answered:
            self._answered = number
            self.delays.append(1e-6 * (now - self._asked[number]))

    def _move(self) -> None:
        began, number = time.monotonic(), 0
        while self._open:
            number += 1
            phase = 2.0 * math.pi * (time.monotonic() - began) / PERIOD
            press = 0.5 * PRESS * (1.0 - math.cos(phase))
            self._asked[number] = time.time_ns()
            command = {"source": self._source, "sequence": number, "to": {"press": press}}
            try:
                self._send({"hand": command})
            except Exception:
                return
            time.sleep(max(0.0, began + number / RATE - time.monotonic()))
