"""A video of a probe's path, as the camera of a scene would take it: rendered once, and kept.

The camera stands where the scene's registration says, and the markers on the grip are those of the
scene's body; so the true pose in each image is known.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from filelock import FileLock
from numpy.typing import NDArray

from us_sim.cache import cache_folder
from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate, rotation_between
from us_sim.recording.path import ProbePath
from us_sim.scene.building import camera_body_of, tracker_poses_of
from us_sim.scene.scene import Scene
from us_sim.tracking.camera.model import write_camera_info
from us_sim.tracking.camera.rendered_views import WEBCAMS, Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

CAMERA = WEBCAMS["640x480"]
RATE = 30.0  # images per second
_EXPOSURE = 0.008  # s
_CODEC = "FFV1"  # lossless
_FORM = 1  # of what is kept: another number for whatever changes the images
_NAMES = ("video.mkv", "camera.yaml")


@dataclass(frozen=True, eq=False)
class PathVideo:
    """A rendered video, and the truth of it."""

    file: Path
    camera_info: Path
    rate: float  # images per second
    poses: list[Pose]  # of the probe in ``patient``, in each image


def path_video(
    scene: Scene, path: ProbePath, progress: Callable[[int, int], None] | None = None
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
    truth = video_poses(path)
    seen = [registration.inverse() @ pose @ calibration.inverse() for pose in truth]
    _require_in_view(scene, body, seen)
    numbers = [CAMERA.matrix, CAMERA.distortion, body.corners, body.ids]
    numbers += [path.log_times - path.log_times[0], path.positions, path.orientations]
    for pose in (registration, calibration):
        numbers += [pose.position, pose.orientation]
    digest = hashlib.sha256(f"{_FORM} {RATE} {_EXPOSURE} {_CODEC} {body.dictionary}".encode())
    for array in numbers:
        digest.update(np.ascontiguousarray(array).tobytes())
    entry = cache_folder() / f"camera_video_{digest.hexdigest()[:20]}"
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(entry.with_name(f"{entry.name}.lock")):
            if not _is_whole(entry):
                _make(entry, body, _motions(path, registration, calibration), seen, progress)
    except OSError as error:
        raise UsSimError(
            f"the camera's video cannot be written to {entry.parent} ({error.strerror or error}): "
            f"set US_SIM_CACHE to a folder that can"
        ) from error
    return PathVideo(entry / _NAMES[0], entry / _NAMES[1], RATE, truth)


def video_poses(path: ProbePath) -> list[Pose]:
    """Where the probe is in each image of the video."""
    return [_pose_at(path, moment) for moment in _moments(path)]


def _moments(path: ProbePath) -> NDArray[np.float64]:
    return np.arange(int(path.duration * RATE + 1e-6) + 1) / RATE


def _pose_at(path: ProbePath, moment: float) -> Pose:
    """Between the two poses around a moment (s); at the ends it rests."""
    times = (path.log_times - path.log_times[0]) * 1e-9
    after = int(np.clip(np.searchsorted(times, moment, side="right"), 1, max(1, len(times) - 1)))
    first, last = (path.pose(i) for i in (after - 1, min(after, len(times) - 1)))
    span = float(times[min(after, len(times) - 1)] - times[after - 1])
    part = (moment - float(times[after - 1])) / span if span > 0 else 0.0
    return interpolate(first, last, float(np.clip(part, 0.0, 1.0)))


def _motions(path: ProbePath, registration: Pose, calibration: Pose) -> list[NDArray[np.float64]]:
    motions = []
    for moment in _moments(path):
        begin, end = (
            registration.inverse()
            @ _pose_at(path, moment + side * 0.5 * _EXPOSURE)
            @ calibration.inverse()
            for side in (-1.0, 1.0)
        )
        turn = rotation_between(begin.orientation, end.orientation)
        motions.append(np.concatenate([end.position - begin.position, turn]))
    return motions


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


def _is_whole(entry: Path) -> bool:
    try:
        notes = yaml.safe_load((entry / _NAMES[1]).read_text(encoding="utf-8"))
        return bool((entry / _NAMES[0]).stat().st_size == notes["video_bytes"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, LookupError, TypeError):
        return False


def _make(
    entry: Path,
    body: RigidBody,
    motions: list[NDArray[np.float64]],
    seen: list[Pose],
    progress: Callable[[int, int], None] | None,
) -> None:
    for left_over in entry.parent.glob(f"{entry.name}.partial-*"):
        shutil.rmtree(left_over, ignore_errors=True)
    partial = Path(tempfile.mkdtemp(prefix=f"{entry.name}.partial-", dir=entry.parent))
    try:
        video = partial / _NAMES[0]
        codec, size = cv2.VideoWriter.fourcc(*_CODEC), (CAMERA.width, CAMERA.height)
        writer = cv2.VideoWriter(str(video), cv2.CAP_FFMPEG, codec, RATE, size, False)
        if not writer.isOpened():
            raise UsSimError(
                f"this OpenCV cannot write {_CODEC} video to {video}: install "
                f"opencv-python-headless with pip, which has FFmpeg"
            )
        room = RenderedView(CAMERA, body)
        for number, (pose, motion) in enumerate(zip(seen, motions, strict=True)):
            if progress is not None:
                progress(number, len(seen))
            writer.write(room.render(pose, Conditions(), 0, motion, number))
        writer.release()
        notes = {"video_bytes": video.stat().st_size, "images": len(seen)}
        write_camera_info(partial / _NAMES[1], CAMERA, "rendered", notes)
        if entry.is_dir():
            shutil.rmtree(entry)
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
