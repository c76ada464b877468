"""A frame's pose in one further up a tree of frames, with every link taken at one time."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate_poses

_REMEMBERED = 4096  # poses, 4 s of 1 kHz and 20 s of 200 Hz
_RESTART = 1_000_000_000  # ns that a stamp jumps back by when its source begins again


class PoseHistory:
    """The last poses of a frame, by stamp; between two of them at most ``longest`` ns apart."""

    def __init__(self, *, longest: int | None = None) -> None:
        self._longest = longest
        self.stamps: deque[int] = deque(maxlen=_REMEMBERED)  # ns, ascending
        self.poses: deque[Pose] = deque(maxlen=_REMEMBERED)

    def append_pose(self, stamp: int, pose: Pose) -> None:
        """Append a pose that is newer than all before."""
        self.stamps.append(stamp)
        self.poses.append(pose)

    def clear(self) -> None:
        """Forget all poses."""
        self.stamps.clear()
        self.poses.clear()

    def interpolate_at(self, stamp: int) -> Pose | None:
        """Interpolate the pose at a stamp; None where it is not known."""
        k = bisect_left(self.stamps, stamp)
        if k < len(self.stamps) and self.stamps[k] == stamp:
            return self.poses[k]
        if not 0 < k < len(self.stamps):
            return None
        before, after = self.stamps[k - 1], self.stamps[k]
        if self._longest is not None and after - before > self._longest:
            return None
        fraction = (stamp - before) / (after - before)
        return interpolate_poses(self.poses[k - 1], self.poses[k], fraction)


class FrameChain:
    """The links from a frame up to another, the top, whose poses come one by one.

    A pose is made at the latest time at which all links are known, as tf2 does: at the stamps of
    the link that comes last, and so mostly of that which moves least often. Each of the others is
    interpolated there, also where its stamps are ahead.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> chain = FrameChain("tool", "world")
        >>> chain.update_link("base", "world", 0, Pose([0.0, 0.0, 0.0]))
        >>> chain.update_link("base", "world", 2_000_000_000, Pose([0.2, 0.0, 0.0]))
        >>> stamp, pose = chain.update_link("tool", "base", 1_000_000_000, Pose([0.0, 0.0, 0.3]))
        >>> stamp, pose.position
        (1000000000, array([0.1, 0. , 0.3]))
    """

    def __init__(self, frame: str, top: str) -> None:
        self._frame, self._top = frame, top
        self._links: dict[str, tuple[str, Pose | PoseHistory]] = {}  # by frame, with its parent
        self._newest: int | None = None  # ns, of the last pose

    def find_links(self) -> list[str] | None:
        """Return the frames from the lowest up to below the top; None while a link is missing."""
        found: list[str] = []
        frame = self._frame
        while frame != self._top:
            if frame not in self._links or frame in found:
                return None
            found.append(frame)
            frame = self._links[frame][0]
        return found

    def _find_moving_links(self) -> dict[str, PoseHistory]:
        """Return the links on the way that are not fixed."""
        links = {link: self._links[link][1] for link in self.find_links() or ()}
        return {link: each for link, each in links.items() if isinstance(each, PoseHistory)}

    @property
    def is_fixed(self) -> bool:
        """True if all links are known and none of them moves."""
        return self.find_links() is not None and not self._find_moving_links()

    def forget_motion(self) -> None:
        """Forget the poses of all moving links."""
        self._newest = None
        for _, link in self._links.values():
            if isinstance(link, PoseHistory):
                link.clear()

    def set_fixed_link(self, frame: str, parent: str, pose: Pose) -> None:
        """Fix a frame at a pose in its parent."""
        self._links[frame] = parent, pose

    def update_link(
        self, frame: str, parent: str, stamp: int, pose: Pose
    ) -> tuple[int, Pose] | None:
        """Add a frame's pose in its parent at a stamp (ns).

        Returns:
            The stamp and the pose of the lowest frame in the top; None where no later one than the
            last can be made.
        """
        above, history = self._links.get(frame, ("", None))
        if above != parent or not isinstance(history, PoseHistory):
            history = PoseHistory()
            self._links[frame] = parent, history
        if history.stamps and stamp <= history.stamps[-1]:
            if stamp > history.stamps[-1] - _RESTART:
                return None
            self.forget_motion()
        history.append_pose(stamp, pose)
        links = self.find_links()
        return self._compose_links(links) if links is not None and frame in links else None

    def _compose_links(self, links: list[str]) -> tuple[int, Pose] | None:
        moving = self._find_moving_links().values()
        if not all(each.stamps for each in moving):
            return None
        stamp = min(each.stamps[-1] for each in moving)
        if self._newest is not None and stamp <= self._newest:
            return None
        found = Pose()
        for link in links:
            _, place = self._links[link]
            pose = place.interpolate_at(stamp) if isinstance(place, PoseHistory) else place
            if pose is None:
                return None
            found = pose @ found
        self._newest = stamp
        return stamp, found

    def find_slowest_link(self) -> tuple[str, float]:
        """Return the link whose newest stamp is the oldest, and the s by which another is newer."""
        newest = {
            link: each.stamps[-1] for link, each in self._find_moving_links().items() if each.stamps
        }
        if not newest:
            return "", 0.0
        last = min(newest, key=newest.__getitem__)
        return last, 1e-9 * (max(newest.values()) - newest[last])
