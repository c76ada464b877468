"""Corners of boards, against those of OpenCV alone: on real photos and in rendered images."""

import cv2
import numpy as np
import pytest
from camera_views import WEBCAM

from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.camera import Board, BoardView, calibrate_camera
from us_sim.tracking.camera.fiducial_detector import detect_corners
from us_sim.tracking.camera.rendered_views import Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

GRID = Board("grid", 4, 5, marker=0.0375, separation=0.005, dictionary="6X6_1000")
CHARUCO = Board("charuco", 5, 7, 0.04, 0.02, dictionary="6X6_250")


@pytest.mark.parametrize(
    ("board", "body", "folder", "names", "best", "opencvs"),
    [
        (
            *(GRID, RigidBody.grid("6X6_1000", 4, 5, 0.0375, 0.005)),
            *("marker-aruco-gridboard", [f"{k}.jpg" for k in range(42)], 0.28, 0.46),
        ),
        (
            *(CHARUCO, RigidBody.charuco("6X6_250", 5, 7, 0.04, 0.02)),
            *("marker-opencv-charuco", [f"img_0{k}.jpg" for k in range(4)], 0.14, 0.19),
        ),
    ],
)
def test_a_calibration_leaves_less_than_with_opencvs(
    shared_data, board, body, folder, names, best, opencvs
):
    images = [cv2.imread(str(shared_data / folder / name), cv2.IMREAD_GRAYSCALE) for name in names]
    views = [BoardView(*map(np.float32, detect_corners(image, body))) for image in images]
    assert calibrate_camera(views, 640, 480).rms == pytest.approx(best, abs=0.01)
    theirs = calibrate_camera([board.find(image) for image in images], 640, 480)
    assert theirs.rms == pytest.approx(opencvs, abs=0.02)


@pytest.mark.parametrize("distance", [0.25, 0.4, 0.6, 0.9])
def test_in_a_rendered_image_they_are_nearer_to_the_true_ones(distance):
    pose = Pose([-0.07, -0.1, distance], [0.1, 0.12, 0.05, 1.0])
    body = RigidBody.charuco("6X6_250", 5, 7, 0.03, 0.02)
    image = RenderedView(WEBCAM, body).render(pose, Conditions())
    seen = Board("charuco", 5, 7, 0.03, 0.02, dictionary="6X6_250").find(image)
    theirs, ours = (
        np.sqrt(np.mean((WEBCAM.project(pose.apply(points)) - pixels) ** 2) * 2)
        for points, pixels in ((np.float64(seen.points), seen.pixels), detect_corners(image, body))
    )
    assert ours < 0.03
    assert 0.05 < theirs < 0.08
