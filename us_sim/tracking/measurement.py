"""A body's pose as a device measured it, and the state of tracking by the age of the last one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose

PATIENT = "patient"  # the frame of the tissue, and of the probe's poses


@dataclass(frozen=True, eq=False)
class Measurement:
    """A body's pose in the device's frame, with its covariance.

    The covariance is that of ROS's PoseWithCovariance: x, y, z (m), then rotations (rad) about
    the axes of the device's frame; so the rotation is exp(rotation) times the pose's.

    Raises:
        TrackingError: the covariance is not a finite symmetric (6, 6) matrix.

    Examples:
        >>> covariance = np.diag([1e-8] * 3 + [1e-5] * 3)
        >>> seen = Measurement(1_000_000_000, Pose([0.0, 0.0, 0.4]), covariance)
        >>> round(1e3 * float(seen.position_deviation), 2)  # mm
        0.17
    """

    stamp: int  # ns, when it was measured: of a camera the middle of the exposure
    pose: Pose
    covariance: NDArray[np.float64] | None = None  # (6, 6) m², m rad, rad²
    error: float | None = None  # what the device says of its fit, in its own unit (pixels, mm)
    of_probe: bool = False  # the pose is the probe's own in ``patient``, and the clock is ours

    def __post_init__(self) -> None:
        if self.covariance is None:
            return
        covariance = np.array(self.covariance, dtype=np.float64)
        if (
            covariance.shape != (6, 6)
            or not np.isfinite(covariance).all()
            or np.abs(covariance - covariance.T).max() > 1e-6 * np.abs(covariance).max()
        ):
            raise TrackingError(
                f"a pose's covariance must be a finite symmetric (6, 6) matrix, not of shape "
                f"{covariance.shape}"
            )
        covariance.flags.writeable = False
        object.__setattr__(self, "covariance", covariance)

    @property
    def position_deviation(self) -> float | None:
        """Root (m) of the summed variances of the position; None where nothing is known."""
        if self.covariance is None:
            return None
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))


class TrackingState(Enum):
    """State of tracking, by the age of the last pose."""

    WAITING = "waiting"  # no pose yet
    TRACKED = "tracked"
    COASTING = "coasting"  # poses are overdue: the probe is taken to be where it was
    LOST = "lost"  # it may be anywhere
