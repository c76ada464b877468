"""Videos of a path: what is in them, that they are kept, and how a tracked path is judged."""

import cv2
import numpy as np
import pandas as pd
import pytest

from us_sim.errors import BagError
from us_sim.geometry.pose import Pose
from us_sim.recording.press_and_slide import press_and_slide
from us_sim.run.camera_video import CAMERA, RATE, path_video, video_poses
from us_sim.run.session_summary import CAMERA_INFO, Session, tracked_path
from us_sim.scene.building import camera_body_of, tracker_poses_of
from us_sim.scene.reading import load_scene
from us_sim.tracking.camera.model import read_camera_info
from us_sim.tracking.camera.source import CameraSource

STEP = round(1e9 / RATE)


@pytest.fixture(scope="module")
def path():
    return press_and_slide(rate=60.0, duration=0.5)


@pytest.fixture(scope="module")
def video(path, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("US_SIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        told = []
        made = path_video(
            load_scene("upper_arm_camera"), path, lambda done, total: told.append((done, total))
        )
        assert told == [(i, 15) for i in range(15)]
        again = path_video(load_scene("upper_arm_camera"), path, lambda *_: told.append(None))
        assert again.file == made.file
        assert None not in told
    return made


def test_every_second_pose_of_a_path_of_60_hz_is_in_the_video(path):
    poses = video_poses(path)
    assert len(poses) == 15
    for number, pose in enumerate(poses):
        np.testing.assert_allclose(pose.position, path.positions[2 * number], atol=1e-9)


@pytest.mark.slow
def test_a_camera_that_sees_the_video_finds_the_probe_where_it_was(video):
    scene = load_scene("upper_arm_camera")
    registration, calibration = tracker_poses_of(scene)
    camera = read_camera_info(video.camera_info)
    np.testing.assert_array_equal(camera.matrix, CAMERA.matrix)
    np.testing.assert_array_equal(camera.distortion, CAMERA.distortion)
    source = CameraSource(camera, camera_body_of(scene), scene.tracker.source.given)
    capture = cv2.VideoCapture(str(video.file))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(RATE)
    for number, pose in enumerate(video.poses):
        image = cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2GRAY)
        seen = source.measure(image, number * STEP)
        probe = registration @ seen.pose @ calibration
        assert np.linalg.norm(probe.position - pose.position) < 3e-4
    assert not capture.read()[0]


def session_of(poses, shown):
    times = {CAMERA_INFO: pd.DataFrame({"stamp": shown})}
    return Session(None, poses, {}, None, None, times, {})


def test_errors_are_those_that_were_put_in(video):
    shown = [10**18 + number * STEP for number in range(15)]
    poses = {
        shown[i]: Pose(
            video.poses[i].position + 1e-3 * i * np.eye(3)[0], video.poses[i].orientation
        )
        for i in range(5, 15)
    }
    found, sentence = tracked_path(session_of(poses, shown), video)
    assert (found["images"], found["shown"], found["tracked"]) == (15, 15, 10)
    assert found["error_mm"] == {"median": 9.5, "p95": 13.55, "max": 14.0}
    assert sentence.startswith("tracked in 10 of 15 images, from the true path: median 9.500 mm")


def test_images_that_were_not_shown_or_came_late_do_not_shift_the_truth(video):
    shown = [10**18 + number * STEP + (-1) ** number * 9_000_000 for number in range(15)]
    del shown[12], shown[3], shown[0]
    numbers = [n for n in range(15) if n not in (0, 3, 12)]
    poses = {stamp: video.poses[n] for stamp, n in zip(shown, numbers, strict=True)}
    shown[-1] = 10**18 + 14 * STEP
    poses[shown[-1]] = video.poses[14]
    found, _ = tracked_path(session_of(poses, shown), video)
    assert found["shown"] == 12
    assert found["error_mm"]["max"] == 0.0


def test_a_session_without_poses_is_refused(video):
    with pytest.raises(BagError, match="no pose of the probe"):
        tracked_path(session_of({}, [1]), video)
