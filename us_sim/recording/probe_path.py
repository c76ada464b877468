"""The poses of one body over time, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose


@dataclass(frozen=True, eq=False)
class ProbePath:
    """Poses in the order in which they were recorded; their stamps may go back."""

    topic: str
    frame_id: str
    stamps: NDArray[np.int64]  # (K,) ns since the epoch, of the messages' headers
    positions: NDArray[np.float64]  # (K, 3) m, frame frame_id
    orientations: NDArray[np.float64]  # (K, 4) x, y, z, w as recorded, not normalised
    log_times: NDArray[np.int64] = field(  # (K,) ns since the epoch; the stamps by default
        default_factory=lambda: np.empty(0, np.int64)
    )
    rejected: int = 0  # poses of the topic left out: not finite, or without an orientation
    note: str = ""  # the recording's faults, in a sentence; empty when there are none

    def __post_init__(self) -> None:
        if not len(self.log_times):
            object.__setattr__(self, "log_times", self.stamps)

    def __len__(self) -> int:
        return len(self.stamps)

    def pose(self, index: int) -> Pose:
        """The pose at a place in the path, its quaternion normalised."""
        return Pose(self.positions[index], self.orientations[index])

    @property
    def poses(self) -> list[Pose]:
        """All poses, as `pose` returns them."""
        return [self.pose(index) for index in range(len(self))]

    @property
    def duration(self) -> float:
        """Seconds from the first to the last recorded pose."""
        return float(self.log_times[-1] - self.log_times[0]) / 1e9 if len(self) else 0.0
