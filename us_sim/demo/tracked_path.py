"""How far the path that a camera tracked is from the true one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.demo.camera_video import PathVideo
from us_sim.demo.session import Session
from us_sim.errors import BagError
from us_sim.tracking.camera.body_pose import rotation_angle

IMAGES = "/camera/camera_info"
"""Comes with each image, and has its stamp."""


@dataclass(frozen=True)
class TrackedPath:
    """Errors of the probe's face on its path."""

    images: int  # of the video
    shown: int  # that the driver published
    mm: NDArray[np.float64]  # (K,) of the images in which the probe was tracked
    degrees: NDArray[np.float64]  # (K,)

    @property
    def summary(self) -> dict[str, Any]:
        """As one JSON-like mapping."""
        summary: dict[str, Any] = {"images": self.images, "shown": self.shown}
        summary["tracked"] = len(self.mm)
        for name, values in (("error_mm", self.mm), ("error_deg", self.degrees)):
            numbers = [round(x, 4) for x in np.percentile(values, [50, 95, 100]).tolist()]
            summary[name] = dict(zip(("median", "p95", "max"), numbers, strict=True))
        return summary

    def __str__(self) -> str:
        """One line for a person."""
        found = self.summary
        mm, degrees = found["error_mm"], found["error_deg"]
        return (
            f"tracked in {found['tracked']} of {found['images']} images, from the true path: "
            f"median {mm['median']:.3f} mm and {degrees['median']:.3f}°, "
            f"95 % within {mm['p95']:.3f} mm and {degrees['p95']:.3f}°"
        )


def tracked_path(session: Session, video: PathVideo) -> TrackedPath:
    """Hold ``probe/pose`` against where the probe was in the image of the same stamp.

    Raises:
        BagError: the session has no image of the camera or no pose of the probe.
    """
    stamps = np.array(sorted(stamp for stamp, _, _ in session.sent.get(IMAGES, [])))
    if not len(stamps) or not session.poses:
        raise BagError(f"the session holds no pose of the probe, or nothing on {IMAGES}")
    # The driver begins when all listen, so the last image is recorded for certain; each of the
    # others is so many periods before it as its stamp says.
    before = np.round((stamps[-1] - stamps) * 1e-9 * video.rate).astype(int)
    shown_at = dict(zip(stamps.tolist(), (len(video.poses) - 1 - before).tolist(), strict=True))
    off, turned = [], []
    for stamp, pose in session.poses.items():
        number = shown_at.get(stamp)
        if number is None or number < 0:
            continue
        true = video.poses[number]
        off.append(1e3 * float(np.linalg.norm(pose.position - true.position)))
        turned.append(float(np.degrees(rotation_angle(pose, true))))
    if not off:
        raise BagError(f"no pose of the probe has the stamp of an image on {IMAGES}")
    return TrackedPath(len(video.poses), len(stamps), np.array(off), np.array(turned))
