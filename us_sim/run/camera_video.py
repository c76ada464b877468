"""A video of a probe's path, as the camera of a scene would take it: rendered once, and kept.

The camera stands where the scene's registration says, and the markers on the grip are those of the
scene's body; so the true pose in each image is known.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.cache import cache_folder
from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_between
from us_sim.recording.path import ProbePath
from us_sim.recording.resampling import slerp
from us_sim.scene.building import camera_body_of, tracker_poses_of
from us_sim.scene.scene import Scene
from us_sim.tracking.camera.model import write_camera_info
from us_sim.tracking.camera.rendered_views import WEBCAMS, Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

CAMERA = WEBCAMS["640x480"]
RATE = 30.0  # images per second
_EXPOSURE = 0.008  # s
_CODEC = "FFV1"  # lossless
_FORM = 2  # of what is kept: another number for whatever changes the images


@dataclass(frozen=True, eq=False)
class PathVideo:
    """A rendered video, and the truth of it."""

    file: Path
    camera_info: Path
    rate: float  # images per second
    poses: list[Pose]  # of the probe in ``patient``, in each image


def path_video(
    scene: Scene, path: ProbePath, progress: Callable[[int, int], None] = lambda *_: None
) -> PathVideo:
    """The video of a path, from the user's cache or rendered into it.

    Args:
        scene: whose tracker is a camera.
        path: in ``patient``.
        progress: called with the images that are done and all, while they are rendered.

    Raises:
        UsSimError: the scene's tracker is no camera, its camera does not see the body, or the
            cache or the video cannot be written.
    """
    if scene.tracker.source.name != "camera":
        raise UsSimError(
            f"--source camera: the tracker of {scene.origin} is "
            f"`{scene.tracker.source.name}`; name a scene whose tracker is a camera, such as "
            f"upper_arm_camera"
        )
    body = camera_body_of(scene)
    registration, calibration = tracker_poses_of(scene)

    def seen(late: float) -> list[Pose]:
        """Where the body is in the camera's frame."""
        poses = video_poses(path, late)
        return [registration.inverse() @ pose @ calibration.inverse() for pose in poses]

    begins, middles, ends = (seen(part * _EXPOSURE) for part in (-0.5, 0.0, 0.5))
    _require_in_view(scene, body, middles)
    motions = [
        np.r_[b.position - a.position, rotation_between(a.orientation, b.orientation)]
        for a, b in zip(begins, ends, strict=True)
    ]
    digest = hashlib.sha256(f"{_FORM} {RATE} {_CODEC} {body.dictionary}".encode())
    shown = [np.r_[pose.position, pose.orientation] for pose in middles]
    for array in (CAMERA.matrix, CAMERA.distortion, body.corners, body.ids, shown, motions):
        digest.update(np.ascontiguousarray(array).tobytes())
    entry = cache_folder() / f"camera_video_{digest.hexdigest()[:20]}"
    video, camera_info = entry / "video.mkv", entry / "camera.yaml"
    try:
        if not entry.is_dir():
            entry.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=entry.parent) as partial:
                made = Path(partial, entry.name)
                made.mkdir()
                _render(made / video.name, body, middles, motions, progress)
                write_camera_info(made / camera_info.name, CAMERA, "rendered")
                made.rename(entry)
    except OSError as error:
        raise UsSimError(
            f"the camera's video cannot be written to {entry.parent} ({error.strerror or error}): "
            f"set US_SIM_CACHE to a folder that can"
        ) from error
    return PathVideo(video, camera_info, RATE, video_poses(path))


def video_poses(path: ProbePath, late: float = 0.0) -> list[Pose]:
    """Where the probe is so many seconds after each image of the video; at the ends it rests."""
    times, first = np.unique(path.log_times, return_index=True)
    poses = np.hstack([path.positions, path.orientations])[first]
    if len(times) == 1:
        return [path.pose(0)]
    moments = np.arange(int(path.duration * RATE + 1e-6) + 1) / RATE + late
    since = np.clip((1e9 * moments).round().astype(np.int64), 0, times[-1] - times[0])
    return [Pose(each[:3], each[3:]) for each in slerp(times, poses, times[0] + since)]


def _require_in_view(scene: Scene, body: RigidBody, seen: list[Pose]) -> None:
    middle = body.centres.mean(axis=0)
    pixels = np.array([CAMERA.project(pose.apply(middle[None]))[0] for pose in seen])
    facing = np.array(
        [
            ((body.normals @ pose.rotation.T) * pose.apply(body.centres)).sum(axis=1).min() < 0
            for pose in seen
        ]
    )
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
    if (inside & facing).mean() < 0.5:
        raise UsSimError(
            f"{scene.origin}: the camera does not see the markers on the path: check "
            f"tracker.registration (camera_optical in patient) and tracker.calibration (the probe "
            f"in the body)"
        )


def _render(
    video: Path,
    body: RigidBody,
    seen: list[Pose],
    motions: list[NDArray[np.float64]],
    progress: Callable[[int, int], None],
) -> None:
    codec, size = cv2.VideoWriter.fourcc(*_CODEC), (CAMERA.width, CAMERA.height)
    writer = cv2.VideoWriter(str(video), cv2.CAP_FFMPEG, codec, RATE, size, False)
    if not writer.isOpened():
        raise UsSimError(
            f"this OpenCV cannot write {_CODEC} video to {video}: install "
            f"opencv-python-headless with pip, which has FFmpeg"
        )
    room = RenderedView(CAMERA, body)
    for number, (pose, motion) in enumerate(zip(seen, motions, strict=True)):
        progress(number, len(seen))
        writer.write(room.render(pose, Conditions(), 0, motion, number))
    writer.release()
