"""Errors, failures and run time of a tracker in one case.

>>> from us_sim.evaluation.tracking.measure import mirror_pose
>>> tilted = Pose([0.0, 0.0, 0.4], [np.sin(0.1), 0.0, 0.0, np.cos(0.1)])
>>> mirror_pose(tilted, np.zeros(3), np.array([0.0, 0.0, 1.0])).orientation.round(4) + 0.0
array([-0.0998,  0.    ,  0.    ,  0.995 ])
"""

from __future__ import annotations

import time
import zlib
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.evaluation.tracking.cases import CONDITIONS, MARKERS, Marker, TrackingCase
from us_sim.geometry.pose import Pose
from us_sim.tracking.camera.body_pose import rotation_angle
from us_sim.tracking.camera.rendered_views import WEBCAMS, RenderedView
from us_sim.tracking.camera.source import VIEW_ANGLE_LIMIT, CameraSource
from us_sim.tracking.measurement import Measurement


class TrackingBench:
    """A bench that renders cases and tracks them; it keeps the renderer of the last body."""

    def __init__(self) -> None:
        self._renderers: dict[tuple[str, str], RenderedView] = {}

    def measure_case(self, case: TrackingCase, sequences: int) -> list[dict[str, Any]]:
        """Measure the row of a case, from sequences of images; ``shots`` has a row a view."""
        marker, camera = MARKERS[case.marker], WEBCAMS[case.image_size]
        key = (case.marker, case.image_size)
        is_new = key not in self._renderers
        if is_new:
            self._renderers = {key: RenderedView(camera, marker.body)}
        renderer = self._renderers[key]
        conditions, _ = CONDITIONS[case.condition]
        rows: list[dict[str, Any]] = []
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for number in range(sequences):
                source = CameraSource(camera, marker.body)
                seed = zlib.crc32(f"{case.key} {number}".encode())
                for frame, pose in enumerate(case.make_sequence(number)):
                    # In a sequence the hand and the light stay, but not the noise.
                    motion = case.compute_motion(number)
                    image = renderer.render(pose, conditions, seed, motion, frame)
                    if is_new:  # what is compiled now must not count
                        CameraSource(camera, marker.body).measure_pose(image, 0)
                        is_new = False
                    rows.append(_measure_view(source, marker, frame, pose, image))
        finally:
            cv2.setNumThreads(threads)
        views = pd.DataFrame(rows)
        found = views[views["detected"]]
        return [
            {
                "views": len(views),
                "detected": len(found),
                "flipped": int(found["flipped"].sum()),
                "median_mm": found["mm"].median(),
                "p95_mm": found["mm"].quantile(0.95),
                "median_deg": found["degrees"].median(),
                "p95_deg": found["degrees"].quantile(0.95),
                "ms_median": views["ms"].median(),
                "ms_first": views["ms"][views["first"]].median(),
                "cpu_ms_median": views["cpu_ms"].median(),
                "markers_used": found["used"].mean(),
                "shots": views,
            }
        ]


def _measure_view(
    source: CameraSource, marker: Marker, frame: int, true: Pose, image: NDArray[np.uint8]
) -> dict[str, Any]:
    """Track one image, and measure time and errors."""
    begin, processor = time.perf_counter(), time.thread_time()
    measured = source.measure_pose(image, round(frame * 1e9 / 30))
    processor, wall = time.thread_time() - processor, time.perf_counter() - begin
    return {
        "first": frame == 0,  # of a sequence: nothing was known before
        "ms": 1e3 * wall,
        "cpu_ms": 1e3 * processor,
        "visible": count_visible(marker, true),
        "detected": measured is not None,
        "used": source.seen if measured else 0,
        **_compare_poses(measured, marker, true),
    }


def count_visible(marker: Marker, pose: Pose) -> int:
    """Count the markers of a body that face the camera within its usual limit of the angle."""
    centres = pose.transform_points(marker.body.centres)
    cosines = -((marker.body.normals @ pose.rotation.T) * centres).sum(axis=1)
    cosines /= np.linalg.norm(centres, axis=1)
    return int((cosines > np.cos(VIEW_ANGLE_LIMIT)).sum())


def _compare_poses(measured: Measurement | None, marker: Marker, true: Pose) -> dict[str, Any]:
    """Compute the errors of the body's middle and rotation."""
    if measured is None:
        return {"flipped": False, "mm": np.nan, "degrees": np.nan}
    found = measured.pose
    middle = marker.body.centres.mean(axis=0)
    off = (found.transform_points(middle[None]) - true.transform_points(middle[None]))[0]
    angle = rotation_angle(found, true)
    other = rotation_angle(found, mirror_pose(true, middle, marker.front))
    return {
        "flipped": bool(other < angle and angle > np.radians(5.0)),
        "mm": 1e3 * float(np.linalg.norm(off)),
        "degrees": float(np.degrees(angle)),
    }


def mirror_pose(pose: Pose, middle: NDArray[np.float64], front: NDArray[np.float64]) -> Pose:
    """Tilt a body to the other side: from afar a plane looks alike in both poses.

    The pose is that of the body in ``camera_optical``; its middle (3,) m, and the unit normal (3,)
    of its front, are in its own frame.
    """
    sight = pose.transform_points(middle[None])[0]
    sight = sight / np.linalg.norm(sight)
    matrix = np.eye(4)
    before, behind = np.eye(3) - 2 * np.outer(sight, sight), np.eye(3) - 2 * np.outer(front, front)
    matrix[:3, :3] = before @ pose.rotation @ behind
    matrix[:3, 3] = pose.position
    return Pose.from_matrix(matrix)
