"""What is kept of frames for those that are compared with them.

>>> from types import SimpleNamespace as Frame
>>> from us_sim.slicing.strain.earlier import Earlier
>>> earlier = Earlier(lambda frame: frame.pixels)
>>> frames = [Frame(number=n, probe="linear", mesh=None, pixels=10 * n) for n in range(4)]
>>> [earlier.before(frame, 2) for frame in frames]
[None, None, 0, 10]
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from us_sim.slicing.frame import Frame


class Earlier:
    """The last frames of one probe and one mesh, as far as they follow one another.

    Args:
        kept: what is kept of each.
    """

    def __init__(self, kept: Callable[[Frame], Any]) -> None:
        self._kept = kept
        self._of: tuple[Any, Any] = (None, None)
        self._frames: deque[tuple[int, Any]] = deque()

    def before(self, frame: Frame, interval: int) -> Any:
        """What was kept of the frame so many before, or None; this one is kept, too.

        A frame may be asked about again.
        """
        probe, mesh = self._of
        if probe is not frame.probe or mesh is not frame.mesh:
            self._of = frame.probe, frame.mesh
            self._frames.clear()
        if not self._frames or self._frames[-1][0] != frame.number:
            self._frames.append((frame.number, self._kept(frame)))
        while self._frames[0][0] < frame.number - interval:
            self._frames.popleft()
        number, kept = self._frames[0]
        return kept if number == frame.number - interval else None
