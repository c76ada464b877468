"""A frame's pose in one further up a tree of frames, with every link taken at one time.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.geometry.frame_chain import FrameChain
>>> chain = FrameChain("tool", "world")
>>> chain.move("base", "world", 0, Pose([0.0, 0.0, 0.0]))
>>> chain.move("base", "world", 2_000_000_000, Pose([0.2, 0.0, 0.0]))
>>> stamp, pose = chain.move("tool", "base", 1_000_000_000, Pose([0.0, 0.0, 0.3]))
>>> stamp, pose.position
(1000000000, array([0.1, 0. , 0.3]))
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate

_REMEMBERED = 4096  # poses, 4 s of 1 kHz and 20 s of 200 Hz
_RESTART = 1_000_000_000  # ns that a stamp jumps back by when its source begins again


class PoseHistory:
    """The last poses of a frame, by their stamps.

    Args:
        longest: ns, between two poses that are interpolated; None for any time.
    """

    def __init__(self, *, longest: int | None = None) -> None:
        self._longest = longest
        self.stamps: deque[int] = deque(maxlen=_REMEMBERED)  # ns, ascending
        self.poses: deque[Pose] = deque(maxlen=_REMEMBERED)

    def add(self, stamp: int, pose: Pose) -> None:
        """Take a pose that is newer than all before."""
        self.stamps.append(stamp)
        self.poses.append(pose)

    def clear(self) -> None:
        """Forget all."""
        self.stamps.clear()
        self.poses.clear()

    def at(self, stamp: int) -> Pose | None:
        """The pose at a stamp, interpolated; None where it is not known."""
        k = bisect_left(self.stamps, stamp)
        if k < len(self.stamps) and self.stamps[k] == stamp:
            return self.poses[k]
        if not 0 < k < len(self.stamps):
            return None
        before, after = self.stamps[k - 1], self.stamps[k]
        if self._longest is not None and after - before > self._longest:
            return None
        fraction = (stamp - before) / (after - before)
        return interpolate(self.poses[k - 1], self.poses[k], fraction)


@dataclass(eq=False)
class _Link:
    """A frame in its parent; without poses over time it is fixed."""

    parent: str
    fixed: Pose | None = None
    moving: PoseHistory = field(default_factory=PoseHistory)

    def at(self, stamp: int) -> Pose | None:
        """The pose at a stamp; None where it was not known yet."""
        return self.moving.at(stamp) if self.fixed is None else self.fixed


class FrameChain:
    """The way from a frame up to another through transforms that come one by one.

    A pose is made at the latest time at which all links are known, as tf2 does: at the stamps of
    the link that comes last, and so mostly of that which moves least often. Each of the others is
    interpolated there, also where its stamps are ahead.

    Args:
        frame: whose pose is wanted.
        top: the frame in which it is wanted.
    """

    def __init__(self, frame: str, top: str) -> None:
        self._frame, self._top = frame, top
        self._links: dict[str, _Link] = {}
        self._newest: int | None = None  # ns, of the last pose

    def links(self) -> list[str] | None:
        """The frames from the lowest up to below the top; None while they do not meet."""
        found: list[str] = []
        frame = self._frame
        while frame != self._top:
            if frame not in self._links or frame in found:
                return None
            found.append(frame)
            frame = self._links[frame].parent
        return found

    @property
    def is_fixed(self) -> bool:
        """Whether there is a way, and nothing on it moves."""
        links = self.links()
        return links is not None and all(self._links[link].fixed for link in links)

    def restart(self) -> None:
        """Forget what moved."""
        self._newest = None
        for link in self._links.values():
            link.moving.clear()

    def fix(self, frame: str, parent: str, pose: Pose) -> None:
        """Put a frame for good at a pose in its parent."""
        self._links[frame] = _Link(parent, pose)

    def move(self, frame: str, parent: str, stamp: int, pose: Pose) -> tuple[int, Pose] | None:
        """Take a frame's pose in its parent at a stamp, ns.

        Returns:
            The stamp and the pose of the lowest frame in the top; None where no later one than the
            last can be made.
        """
        link = self._links.get(frame)
        if link is None or link.parent != parent or link.fixed is not None:
            link = self._links[frame] = _Link(parent)
        stamps = link.moving.stamps
        if stamps and stamp <= stamps[-1]:
            if stamp > stamps[-1] - _RESTART:
                return None
            self.restart()
        link.moving.add(stamp, pose)
        links = self.links()
        return self._composed(links) if links is not None and frame in links else None

    def _composed(self, links: list[str]) -> tuple[int, Pose] | None:
        stamps = [self._links[each].moving.stamps for each in links if not self._links[each].fixed]
        if not all(stamps):
            return None
        stamp = min(each[-1] for each in stamps)
        if self._newest is not None and stamp <= self._newest:
            return None
        found = Pose()
        for link in links:
            pose = self._links[link].at(stamp)
            if pose is None:
                return None
            found = pose @ found
        self._newest = stamp
        return stamp, found

    def lag(self) -> tuple[str, float]:
        """The link whose newest stamp is the oldest, and the s by which another one is newer."""
        newest = {
            link: self._links[link].moving.stamps[-1]
            for link in self.links() or ()
            if self._links[link].moving.stamps
        }
        if not newest:
            return "", 0.0
        last = min(newest, key=newest.__getitem__)
        return last, 1e-9 * (max(newest.values()) - newest[last])
