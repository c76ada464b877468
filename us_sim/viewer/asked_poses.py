"""Which page asked for which pose of the probe, and which holds it.

>>> from us_sim.viewer.asked_poses import AskedPoses
>>> asked = AskedPoses()
>>> asked.published(stamp=1)
>>> asked.ask("a page", 7)
>>> asked.published(stamp=2)
>>> asked.by(1), asked.by(2), asked.holder, asked.is_moving
(None, ('a page', 7), 'a page', True)
"""

from __future__ import annotations

import time

_KEPT = 512  # poses
_MOVES_S = 2.0  # after its last wish a page holds the probe, and moves it no more


class AskedPoses:
    """What pages have asked, and the poses that contain it.

    It is written in one thread, and may be read in others.
    """

    def __init__(self) -> None:
        self.at = 0.0
        """When the last wish came, s of the monotonic clock."""
        self.holder = ""
        """The page that acted last; nothing if none has, or once it has gone."""
        self._connection = 0
        self._last: tuple[str, int] | None = None
        self._by_stamp: dict[int, tuple[str, int]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether the page that holds the probe has moved it a moment ago."""
        return bool(self.holder) and time.monotonic() - self.at < _MOVES_S

    def ask(self, source: str, sequence: int, connection: int = 0) -> None:
        """A page (``source``), on a connection, has a wish, by the page's own number."""
        self._last = (source, sequence)
        self.at = time.monotonic()
        self.hold(source, connection)

    def hold(self, source: str, connection: int = 0) -> None:
        """A page holds the probe from here on, until another acts or its connection ends."""
        self.holder, self._connection = source, connection

    def left(self, connection: int) -> None:
        """A connection has ended."""
        if connection == self._connection:
            self.holder = ""

    def published(self, stamp: int) -> None:
        """The pose of a stamp (ns) contains all that has been asked until now."""
        if self._last is None:
            return
        self._by_stamp[stamp] = self._last
        if len(self._by_stamp) > _KEPT:
            del self._by_stamp[next(iter(self._by_stamp))]

    def by(self, stamp: int) -> tuple[str, int] | None:
        """The page, and the number of its last wish, that the pose of a stamp (ns) contains."""
        return self._by_stamp.get(stamp)
