"""One message to the page: a header of JSON, and bytes.

>>> from us_sim.viewer.stream import Packet
>>> packet = Packet("image", 7, {"rows": 1, "columns": 4}, bytes([0, 85, 170, 255]))
>>> len(packet.encoded) % 4, Packet.decoded(packet.encoded) == packet
(0, True)

The newest of a stream, made only while somebody watches.

>>> from us_sim.viewer.stream import Feed
>>> from us_sim.viewer.stream import Packet
>>> feed = Feed("image", lambda watched: print("watched" if watched else "left"))
>>> told = []
>>> feed.watch(lambda: told.append(feed.sequence))
watched
>>> feed.offer(lambda sequence: Packet("image", sequence, {}, b"first"))
>>> feed.offer(lambda sequence: Packet("image", sequence, {}, b"second"))
>>> told, feed.newest().payload
([1, 2], b'second')

The websocket of one page: packets of the streams it watches, and its commands.

The simulator as the page sees it: what streams, and what can be asked of it.
"""

from __future__ import annotations

import itertools
import json
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

_LENGTH = struct.Struct("<I")
_ALIGNMENT = 8
"""Bytes: where the payload begins is a multiple, so that the page can look at it as numbers."""


@dataclass(frozen=True)
class Packet:
    """What one message of a stream holds."""

    kind: str  # the stream's name
    sequence: int  # counts the messages of the stream
    header: Mapping[str, Any]  # JSON-like, without numbers that are none
    payload: bytes

    @cached_property
    def encoded(self) -> bytes:
        """As sent: length of the header (32 bits, little endian), header, payload."""
        header = {"kind": self.kind, "sequence": self.sequence, **self.header}
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-(_LENGTH.size + len(text)) % _ALIGNMENT)
        return b"".join((_LENGTH.pack(len(text)), text, self.payload))

    @classmethod
    def decoded(cls, data: bytes) -> Packet:
        """The packet of :attr:`encoded`."""
        (length,) = _LENGTH.unpack_from(data)
        header = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        kind, sequence = header.pop("kind"), header.pop("sequence")
        return cls(kind, sequence, header, data[_LENGTH.size + length :])


Pack = Callable[[int], Packet | None]
"""Makes the packet of a number; None where what came cannot be used."""
Notify = Callable[[], None]


class Feed:
    """One stream: the graph offers, pages watch and take, each in a thread of its own.

    Args:
        kind: the stream's name, which its packets bear.
        on_watch: called with True when the first begins to watch and with False when the last has
            left, in the thread of whoever does.
        rate: Hz; a page is sent so many at most. None is each of them, in place of the newest of
            several: of things that are told once.
    """

    def __init__(
        self,
        kind: str,
        on_watch: Callable[[bool], object] = lambda _: None,
        rate: float | None = 30.0,
    ) -> None:
        self.kind, self.rate = kind, rate
        self._on_watch = on_watch
        self._watchers: list[Notify] = []
        self._lock = threading.Lock()
        self._packing = threading.Lock()
        self._pack: Pack | None = None
        self._packed: tuple[int, Packet | None] = (0, None)
        self._sequence = 0

    @property
    def sequence(self) -> int:
        """The number of the newest; 0 before the first."""
        return self._sequence

    @property
    def is_watched(self) -> bool:
        """Whether anybody watches."""
        return bool(self._watchers)

    def watch(self, notify: Notify) -> None:
        """Have ``notify`` called, from any thread, whenever there is a newer one."""
        with self._lock:
            self._watchers.append(notify)
            first = len(self._watchers) == 1
        if first:
            self._on_watch(True)

    def unwatch(self, notify: Notify) -> None:
        """No longer."""
        with self._lock:
            self._watchers.remove(notify)
            last = not self._watchers
        if last:
            self._on_watch(False)

    def offer(self, pack: Pack) -> None:
        """There is a newer one, which ``pack`` makes if anybody takes it."""
        with self._lock:
            self._sequence += 1
            self._pack = pack
            watchers = list(self._watchers)
        for notify in watchers:
            notify()

    def forget(self) -> None:
        """What was offered holds no longer, as when the scene is another."""
        with self._lock:
            self._pack = None

    def newest(self) -> Packet | None:
        """The newest packet, made once for all pages; None where there is none that can be used."""
        with self._packing:
            with self._lock:
                sequence, pack = self._sequence, self._pack
            if pack is None:
                return None
            if self._packed[0] != sequence:
                self._packed = sequence, pack(sequence)
            return self._packed[1]


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
