"""Which page asked for which pose of the probe.

>>> from us_sim.viewer.asked_poses import AskedPoses
>>> asked = AskedPoses()
>>> asked.published(stamp=1)
>>> asked.ask("a page", 7)
>>> asked.published(stamp=2)
>>> asked.by(1), asked.by(2), asked.mover
(None, ('a page', 7), 'a page')
"""

from __future__ import annotations

import time

__all__ = ["AskedPoses"]

_KEPT = 512  # poses
_MOVES_S = 2.0  # after its last wish a page moves the probe no more


class AskedPoses:
    """What pages have asked, and the poses that contain it.

    It is written in one thread, and may be read in others.
    """

    def __init__(self) -> None:
        self.at = 0.0
        """When the last wish came, s of the monotonic clock."""
        self._last: tuple[str, int] | None = None
        self._by_stamp: dict[int, tuple[str, int]] = {}

    @property
    def mover(self) -> str:
        """The page that moves the probe now, or nothing if none has for a while."""
        is_moving = self._last is not None and time.monotonic() - self.at < _MOVES_S
        return self._last[0] if self._last is not None and is_moving else ""

    def ask(self, source: str, sequence: int) -> None:
        """A page (``source``) has a wish, by the page's own number."""
        self._last = (source, sequence)
        self.at = time.monotonic()

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
