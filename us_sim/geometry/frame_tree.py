"""Frames and their parents, as `tf` tells them, and the chain from one up to another.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.geometry.frame_tree import FrameTree
>>> tree = FrameTree()
>>> tree.place("tool", "base", Pose([0.0, 0.0, 0.2])), tree.place("tip", "tool", Pose([0.1, 0, 0]))
(True, True)
>>> tree.chain("tip", "base")
['tip', 'tool']
>>> tree.pose(tree.chain("tip", "base")).position
array([0.1, 0. , 0.2])
"""

from __future__ import annotations

from collections.abc import Sequence

from us_sim.geometry.pose import Pose

_MOST = 1000
"""Most frames kept; a tree of more is somebody's mistake."""


class FrameTree:
    """The last known pose of each frame in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def __len__(self) -> int:
        return len(self._parents)

    def place(self, frame: str, parent: str, pose: Pose) -> bool:
        """Put a frame at a pose in its parent; False where there are too many frames."""
        if frame not in self._parents and len(self._parents) >= _MOST:
            return False
        self._parents[frame] = parent, pose
        return True

    def chain(self, frame: str, top: str) -> list[str] | None:
        """The frames from ``frame`` up to below ``top``; None when they do not meet."""
        frames: list[str] = []
        while frame != top:
            if frame not in self._parents or frame in frames:
                return None
            frames.append(frame)
            frame = self._parents[frame][0]
        return frames

    def pose(self, chain: Sequence[str]) -> Pose:
        """The pose of a chain's first frame in the parent of its last frame."""
        pose = Pose()
        for frame in chain:
            pose = self._parents[frame][1] @ pose
        return pose
