"""The newest of a stream, made only while somebody watches.

>>> from us_sim.viewer.feed import Feed
>>> from us_sim.viewer.packet import Packet
>>> feed = Feed("image", lambda watched: print("watched" if watched else "left"))
>>> told = []
>>> feed.watch(lambda: told.append(feed.sequence))
watched
>>> feed.offer(lambda sequence: Packet("image", sequence, {}, b"first"))
>>> feed.offer(lambda sequence: Packet("image", sequence, {}, b"second"))
>>> told, feed.newest().payload
([1, 2], b'second')
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from us_sim.viewer.packet import Packet

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
