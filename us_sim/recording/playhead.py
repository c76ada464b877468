"""The place of a player in a recording, whose pace may change. Times in ns.

>>> from us_sim.recording.playhead import Playhead
>>> head = Playhead(rate=2.0)
>>> head.go_to(100, now=1000)
>>> head.compute_position(now=1050)
200
>>> head.set_rate(1.0, now=1050)
>>> head.set_held(True, now=1060)
>>> head.compute_position(now=9999)
210
>>> head.set_held(False, now=9999)
>>> head.compute_position(now=10009)
220
"""

from __future__ import annotations


class Playhead:
    """Goes on with a clock that is told to it; the rate is recorded time over the clock's."""

    def __init__(self, rate: float = 1.0) -> None:
        self.rate = rate
        self.is_paused = False
        self._at = 0  # in the recording,
        self._since = 0  # at this time of the clock

    def compute_position(self, now: int) -> int:
        """Return how far after the recording's start it is."""
        return self._at if self.is_paused else self._at + round((now - self._since) * self.rate)

    def compute_start(self, now: int) -> int:
        """Return when it would have been at the start, had it always gone at this rate."""
        return now - round(self.compute_position(now) / self.rate)

    def go_to(self, position: int, now: int) -> None:
        """Jump to a position (ns of the recording) at a time of the clock."""
        self._at, self._since = position, now

    def set_rate(self, rate: float, now: int) -> None:
        """Change the pace."""
        self.go_to(self.compute_position(now), now)
        self.rate = rate

    def set_held(self, is_held: bool, now: int) -> None:
        """Hold the playhead, or let it go on; do nothing if it is so already."""
        if is_held != self.is_paused:
            self.go_to(self.compute_position(now), now)
            self.is_paused = is_held
