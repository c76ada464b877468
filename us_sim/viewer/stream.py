"""Streams to the pages: packets, feeds that make them while watched, and the streams of one page.

>>> from us_sim.viewer.stream import Feed, Packet
>>> packet = Packet("image", 7, {"rows": 1, "columns": 4}, bytes([0, 85, 170, 255]))
>>> len(packet.encoded) % 4, Packet.from_bytes(packet.encoded) == packet
(0, True)
>>> feed = Feed("image", lambda watched: print("watched" if watched else "left"))
>>> numbers = []
>>> feed.add_watcher(lambda: numbers.append(feed.sequence))
watched
>>> feed.offer_packet(lambda sequence: Packet("image", sequence, {}, b"first"))
>>> feed.offer_packet(lambda sequence: Packet("image", sequence, {}, b"second"))
>>> numbers, feed.get_newest().payload
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
_ALIGNMENT = 8  # bytes; at a multiple of it the page can read the payload as numbers
_LONGEST = 65536  # characters of a page's message
_numbers = itertools.count(1)
ONLY_WATCHES = "This page only watches: open it without ?watch to change something"


@dataclass(frozen=True)
class Packet:
    """A message to the page: a JSON header, and bytes."""

    kind: str  # the stream's name
    sequence: int  # number of the message in the stream
    header: Mapping[str, Any]  # of JSON's types, numbers finite
    payload: bytes

    @cached_property
    def encoded(self) -> bytes:
        """The bytes to send: length of the header (32 bits, little endian), header, payload."""
        header = {"kind": self.kind, "sequence": self.sequence, **self.header}
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-(_LENGTH.size + len(text)) % _ALIGNMENT)
        return b"".join((_LENGTH.pack(len(text)), text, self.payload))

    @classmethod
    def from_bytes(cls, data: bytes) -> Packet:
        """Decode the bytes of `encoded`."""
        (length,) = _LENGTH.unpack_from(data)
        header = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        kind, sequence = header.pop("kind"), header.pop("sequence")
        return cls(kind, sequence, header, data[_LENGTH.size + length :])


Pack = Callable[[int], Packet | None]
"""Makes the packet with a sequence number; returns None if the message cannot be used."""


class Feed:
    """The newest packet of one stream; the node offers packets, pages take them, in any thread.

    Args:
        kind: the stream's name, in each of its packets.
        on_watch: called with True when the first page begins to watch and with False when the last
            has left, in the thread of that page.
        rate: Hz, largest rate for each page; None sends every packet.
    """

    def __init__(
        self,
        kind: str,
        on_watch: Callable[[bool], object] = lambda _: None,
        rate: float | None = 30.0,
    ) -> None:
        self.kind, self.rate = kind, rate
        self.sequence = 0  # of the newest packet; 0 before the first
        self._on_watch = on_watch
        self._watchers: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._packing = threading.Lock()
        self._pack: Pack | None = None
        self._packed: tuple[int, Packet | None] = (0, None)

    @property
    def is_watched(self) -> bool:
        """True while a page watches."""
        return bool(self._watchers)

    def add_watcher(self, notify: Callable[[], None]) -> None:
        """Call ``notify`` for each newer packet, in the thread that offers it."""
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
        """Announce a newer packet; ``pack`` makes it when a page takes it."""
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
        """Return the newest packet, made once for all pages; None without a usable one."""
        with self._packing:
            with self._lock:
                sequence, pack = self.sequence, self._pack
            if pack is None:
                return None
            if self._packed[0] != sequence:
                self._packed = sequence, pack(sequence)
            return self._packed[1]


@dataclass
class PageSources:
    """Feeds, commands and boards of all pages; the node ``viewer``, or a test, fills it."""

    feeds: dict[str, Feed] = field(default_factory=dict)  # by kind
    commands: dict[str, Callable[[Any, int], str | None]] = field(default_factory=dict)
    """By key of a page's message: takes value and page number, returns an error or None."""
    nodes: RemoteParameters = field(default_factory=RemoteParameters)
    status: StatusBoard = field(default_factory=StatusBoard)
    session: SessionBoard = field(default_factory=SessionBoard)
    ask_scorer: Callable[[str], object] = lambda _: None  # to "clear" or to "draw"
    leaving: list[Callable[[int], object]] = field(default_factory=list)
    """Called with a page's number when the page has gone."""

    @property
    def is_changing_by_itself(self) -> bool:
        """True while a page watches blood or a strip of time, which also change at rest."""

        def watched(kind: str) -> bool:
            return kind in self.feeds and self.feeds[kind].is_watched

        overlay = self.nodes.get_node("slice_interpolator").parameters.get("overlay")
        colours = overlay is not None and overlay.raw == "velocity" and watched("annotated")
        return colours or any(map(watched, STRIPS))

    def add_feeds(self, *feeds: Feed) -> None:
        """Add feeds that pages can watch."""
        self.feeds |= {feed.kind: feed for feed in feeds}


class PageStream:
    """The streams that one page watches, and the packets that are due.

    A page tells which streams it watches and, for each, when it has drawn the last packet. It gets
    the newest packet as soon as it is ready: a slow page gets fewer packets, not older ones.

    Args:
        sources: has the feeds and takes the commands.
        wake: called, in any thread, when a packet may be due.
        only_watches: refuse the page's commands.
    """

    def __init__(
        self, sources: PageSources, wake: Callable[[], None], *, only_watches: bool = False
    ) -> None:
        self.number = next(_numbers)
        self._only_watches = only_watches
        self._sources, self._wake = sources, wake
        self._watched: dict[str, Feed] = {}
        self._ready: set[str] = set()
        self._sent: dict[str, int] = {}
        self._earliest: dict[str, float] = {}  # s, time before which the next must wait

    def obey_message(self, text: str) -> str | None:
        """Obey a page's message; return an error for a person, or None."""
        try:
            message = json.loads(text) if len(text) <= _LONGEST else None
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict):
            return "what the page sent is no JSON object: load the page again"
        for key, value in message.items():
            problem = self._obey(key, value)
            if problem:
                return problem
        return None

    def _obey(self, key: str, value: Any) -> str | None:
        if key == "watch" and isinstance(value, list):
            self.watch_kinds([kind for kind in value if isinstance(kind, str)])
        elif key == "next" and isinstance(value, str):
            self._ready.add(value)
            self._wake()
        elif key in self._sources.commands:
            command = self._sources.commands[key]
            return ONLY_WATCHES if self._only_watches else command(value, self.number)
        else:
            return f"the page sent {key!r}, which the viewer does not know: load the page again"
        return None

    def watch_kinds(self, kinds: list[str]) -> None:
        """Watch the streams of these kinds only; ignore unknown kinds, which may come later."""
        for kind in self._watched.keys() - set(kinds):
            self._watched.pop(kind).remove_watcher(self._wake)
        for kind in kinds:
            feed = self._sources.feeds.get(kind)
            if feed is not None and kind not in self._watched:
                self._watched[kind] = feed
                self._ready.add(kind)
                self._sent[kind] = 0
                feed.add_watcher(self._wake)
        self._wake()

    def collect_due(self, now: float) -> tuple[list[bytes], float | None]:
        """Collect the packets to send now.

        Args:
            now: s, of a monotonic clock.

        Returns:
            the encoded packets, and s until the next waiting one is due; None if none waits.
        """
        packets, shortest = [], None
        for kind, feed in self._watched.items():
            if kind not in self._ready or feed.sequence == self._sent[kind]:
                continue
            wait = self._earliest.get(kind, now) - now
            if wait > 0:
                shortest = wait if shortest is None else min(shortest, wait)
                continue
            packet = feed.get_newest()
            self._sent[kind] = feed.sequence if packet is None else packet.sequence
            if packet is not None:
                self._ready.discard(kind)
                if feed.rate:  # at even intervals; a pause does not earn packets ahead of time
                    beat = self._earliest.get(kind, now) + 1.0 / feed.rate
                    self._earliest[kind] = max(beat, now)
                packets.append(packet.encoded)
        return packets, shortest


class CallPoster:
    """Runs calls from any thread in the node's thread, in order.

    Args:
        node: the node that is spun, now or later.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._work: deque[Callable[[], object]] = deque()

    def __call__(self, work: Callable[[], object]) -> None:
        """Run a call soon."""
        self._work.append(work)
        self._node.call_soon(self._run)

    def _run(self) -> None:
        if self._work:
            work = self._work.popleft()
            if self._work:  # calls from before the node was spun
                self._node.call_soon(self._run)
            work()
