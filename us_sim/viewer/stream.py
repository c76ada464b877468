"""Streams to the pages: packets, feeds that make them while watched, and the side of one page.

>>> from us_sim.viewer.stream import Feed, Packet
>>> packet = Packet("image", 7, {"rows": 1, "columns": 4}, bytes([0, 85, 170, 255]))
>>> len(packet.encoded) % 4, Packet.from_bytes(packet.encoded) == packet
(0, True)
>>> feed = Feed("image", lambda watched: print("watched" if watched else "left"))
>>> told = []
>>> feed.add_watcher(lambda: told.append(feed.sequence))
watched
>>> feed.offer_packet(lambda sequence: Packet("image", sequence, {}, b"first"))
>>> feed.offer_packet(lambda sequence: Packet("image", sequence, {}, b"second"))
>>> told, feed.get_newest().payload
([1, 2], b'second')
"""

from __future__ import annotations

import itertools
import json
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.slicing.settings import STRIPS
from us_sim.viewer.remote_parameters import RemoteParameters
from us_sim.viewer.session import SessionBoard
from us_sim.viewer.status import StatusBoard

_LENGTH = struct.Struct("<I")
_ALIGNMENT = 8  # bytes: the payload begins at a multiple, so that the page can read it as numbers
_LONGEST = 65536  # characters of a page's message
_numbers = itertools.count(1)
ONLY_WATCHES = "This page only watches: open it without ?watch to change something"


@dataclass(frozen=True)
class Packet:
    """A message to the page: a header of JSON, and bytes."""

    kind: str  # the stream's name
    sequence: int  # counts the messages of the stream
    header: Mapping[str, Any]  # JSON-like, of finite numbers
    payload: bytes

    @cached_property
    def encoded(self) -> bytes:
        """As sent: length of the header (32 bits, little endian), header, payload."""
        header = {"kind": self.kind, "sequence": self.sequence, **self.header}
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-(_LENGTH.size + len(text)) % _ALIGNMENT)
        return b"".join((_LENGTH.pack(len(text)), text, self.payload))

    @classmethod
    def from_bytes(cls, data: bytes) -> Packet:
        """The packet of :attr:`encoded`."""
        (length,) = _LENGTH.unpack_from(data)
        header = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        kind, sequence = header.pop("kind"), header.pop("sequence")
        return cls(kind, sequence, header, data[_LENGTH.size + length :])


Pack = Callable[[int], Packet | None]
"""Makes the packet of a number; None where the message cannot be used."""


class Feed:
    """The newest of one stream: the graph offers, pages watch and take, each in its own thread.

    Args:
        kind: the stream's name, which its packets bear.
        on_watch: called with True when the first page begins to watch and with False when the last
            has left, in the thread of that page.
        rate: Hz, at most, for each page; None sends every packet, of things that are told once.
    """

    def __init__(
        self,
        kind: str,
        on_watch: Callable[[bool], object] = lambda _: None,
        rate: float | None = 30.0,
    ) -> None:
        self.kind, self.rate = kind, rate
        self.sequence = 0  # the number of the newest; 0 before the first
        self._on_watch = on_watch
        self._watchers: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._packing = threading.Lock()
        self._pack: Pack | None = None
        self._packed: tuple[int, Packet | None] = (0, None)

    @property
    def is_watched(self) -> bool:
        """Whether any page watches."""
        return bool(self._watchers)

    def add_watcher(self, notify: Callable[[], None]) -> None:
        """Have ``notify`` called, from any thread, whenever there is a newer packet."""
        with self._lock:
            self._watchers.append(notify)
            first = len(self._watchers) == 1
        if first:
            self._on_watch(True)

    def remove_watcher(self, notify: Callable[[], None]) -> None:
        """Stop the calls of ``notify``."""
        with self._lock:
            self._watchers.remove(notify)
            last = not self._watchers
        if last:
            self._on_watch(False)

    def offer_packet(self, pack: Pack) -> None:
        """Announce a newer packet, which ``pack`` makes if any page takes it."""
        with self._lock:
            self.sequence += 1
            self._pack = pack
            watchers = list(self._watchers)
        for notify in watchers:
            notify()

    def forget_packet(self) -> None:
        """Drop the newest packet, as when another scene is loaded."""
        with self._lock:
            self._pack = None

    def get_newest(self) -> Packet | None:
        """The newest packet, made once for all pages; None where there is none to be used."""
        with self._packing:
            with self._lock:
                sequence, pack = self.sequence, self._pack
            if pack is None:
                return None
            if self._packed[0] != sequence:
                self._packed = sequence, pack(sequence)
            return self._packed[1]


@dataclass
class Simulator:
    """The simulator as pages see it; filled by the node ``viewer``, or by a test."""

    feeds: dict[str, Feed] = field(default_factory=dict)  # by kind
    commands: dict[str, Callable[[Any, int], str | None]] = field(default_factory=dict)
    """By the key of a page's message: takes the value and the page's number, returns an error."""
    nodes: RemoteParameters = field(default_factory=RemoteParameters)
    status: StatusBoard = field(default_factory=StatusBoard)
    session: SessionBoard = field(default_factory=SessionBoard)
    ask_scorer: Callable[[str], object] = lambda _: None  # to "clear" or to "draw"
    leaving: list[Callable[[int], object]] = field(default_factory=list)
    """Called with a page's number when it has gone."""

    @property
    def is_changing_by_itself(self) -> bool:
        """Whether a page watches blood or a strip of time, which go on while the probe rests."""

        def watched(kind: str) -> bool:
            return kind in self.feeds and self.feeds[kind].is_watched

        overlay = self.nodes.get_node("slice_interpolator").parameters.get("overlay")
        colours = overlay is not None and overlay.raw == "velocity" and watched("annotated")
        return colours or any(map(watched, STRIPS))

    def add_feeds(self, *feeds: Feed) -> None:
        """Let pages watch these."""
        self.feeds |= {feed.kind: feed for feed in feeds}


class PageStream:
    """The streams that one page watches, and the packets that are due.

    A page says what it watches and then, for each stream, when it has drawn what came: so the
    newest is sent as soon as the page is ready, and a slow page gets fewer, not older ones.

    Args:
        simulator: whose feeds and commands.
        wake: called, from any thread, when something may be due.
        only_watches: whether the page's commands are refused.
    """

    def __init__(
        self, simulator: Simulator, wake: Callable[[], None], *, only_watches: bool = False
    ) -> None:
        self.number = next(_numbers)
        self._only_watches = only_watches
        self._simulator, self._wake = simulator, wake
        self._watched: dict[str, Feed] = {}
        self._ready: set[str] = set()
        self._sent: dict[str, int] = {}
        self._earliest: dict[str, float] = {}  # s, when the next may be sent

    def obey_message(self, text: str) -> str | None:
        """Obey a page's message; an error for a person, or None."""
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
            self.watch_kinds([kind for kind in value if isinstance(kind, str)])
        elif key == "next" and isinstance(value, str):
            self._ready.add(value)
            self._wake()
        elif key in self._simulator.commands:
            command = self._simulator.commands[key]
            return ONLY_WATCHES if self._only_watches else command(value, self.number)
        else:
            return f"the page sent {key!r}, which the viewer does not know: load the page again"
        return None

    def watch_kinds(self, kinds: list[str]) -> None:
        """Watch these, and no others; kinds that are not known may come later."""
        for kind in self._watched.keys() - set(kinds):
            self._watched.pop(kind).remove_watcher(self._wake)
        for kind in kinds:
            feed = self._simulator.feeds.get(kind)
            if feed is not None and kind not in self._watched:
                self._watched[kind] = feed
                self._ready.add(kind)
                self._sent[kind] = 0
                feed.add_watcher(self._wake)
        self._wake()

    def collect_due(self, now: float) -> tuple[list[bytes], float | None]:
        """The encoded packets to be sent now, and s until one that waits may be; None without.

        Args:
            now: s, of a monotonic clock.
        """
        packets, later = [], None
        for kind, feed in self._watched.items():
            if kind not in self._ready or feed.sequence == self._sent[kind]:
                continue
            wait = self._earliest.get(kind, now) - now
            if wait > 0:
                later = wait if later is None else min(later, wait)
                continue
            packet = feed.get_newest()
            self._sent[kind] = feed.sequence if packet is None else packet.sequence
            if packet is not None:
                self._ready.discard(kind)
                if feed.rate:  # on the beat of the rate, and not sooner after a rest
                    beat = self._earliest.get(kind, now) + 1.0 / feed.rate
                    self._earliest[kind] = max(beat, now)
                packets.append(packet.encoded)
        return packets, later


class CallPoster:
    """Runs calls from any thread in the node's thread, in order.

    Args:
        node: that is spun, or will be.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._work: deque[Callable[[], object]] = deque()

    def __call__(self, work: Callable[[], object]) -> None:
        """Run it soon."""
        self._work.append(work)
        self._node.call_soon(self._run)

    def _run(self) -> None:
        if self._work:
            work = self._work.popleft()
            if self._work:  # such as what was asked for before the node was spun
                self._node.call_soon(self._run)
            work()
