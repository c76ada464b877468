"""Where in a recording a player is, whose pace may change while it plays. Times in ns.

>>> from us_sim.recording.playhead import Playhead
>>> head = Playhead(rate=2.0)
>>> head.go_to(100, now=1000)
>>> head.position(now=1050)
200
>>> head.run_at(1.0, now=1050)
>>> head.hold(True, now=1060)
>>> head.position(now=9999)
210
>>> head.hold(False, now=9999)
>>> head.position(now=10009)
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

    def position(self, now: int) -> int:
        """Return how far after the recording's start it is."""
        return self._at if self.is_paused else self._at + round((now - self._since) * self.rate)

    def begun(self, now: int) -> int:
        """Return when it would have been at the start, had it always gone at this rate."""
        return now - round(self.position(now) / self.rate)

    def go_to(self, position: int, now: int) -> None:
        """Be there at that time."""
        self._at, self._since = position, now

    def run_at(self, rate: float, now: int) -> None:
        """Change the pace."""
        self.go_to(self.position(now), now)
        self.rate = rate

    def hold(self, is_held: bool, now: int) -> None:
        """Stay there, or go on from there; nothing happens where that is so already."""
        if is_held != self.is_paused:
            self.go_to(self.position(now), now)
            self.is_paused = is_held
