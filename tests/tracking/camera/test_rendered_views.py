"""Rendered camera views, against OpenCV's projection and known amounts of light and noise."""

import cv2
import numpy as np
import pytest

from us_sim.geometry.pose import Pose
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rendered_views import SHARP, Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

MATRIX = np.array([[600.0, 0, 322.3], [0, 604.0, 238.1], [0, 0, 1]])
LENS = np.array([-0.25, 0.08, 0.0012, -0.0009, 0.01])
FACING = [1.0, 0.0, 0.0, 0.0]  # of a single marker's frame, whose z comes out of the paper


@pytest.fixture(scope="module")
def camera():
    return CameraModel(640, 480, MATRIX, LENS)


@pytest.mark.parametrize("turn", [[0.4, -0.2, 0.3], [-0.1, 0.5, -2.0]])
def test_corners_are_where_opencv_projects_them(camera, turn):
    body = RigidBody.create_charuco("4X4_50", 5, 4, 0.024, 0.012)  # no marker near a corner
    rotation, _ = cv2.Rodrigues(np.array(turn))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, [0.01, -0.02, 0.35]
    matrix[:3, 3] -= rotation @ body.chessboard.corners.mean(axis=0)
    # OpenCV finds corners best where the lens is a little out of focus.
    soft = Conditions(defocus=1.0, read_noise=0, shot_noise=0)
    image = RenderedView(camera, body).render(Pose.from_matrix(matrix), soft)
    expected, _ = cv2.projectPoints(
        body.chessboard.corners, np.array(turn), matrix[:3, 3], MATRIX, LENS
    )
    expected = expected.reshape(-1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    found = cv2.cornerSubPix(image, np.float32(expected), (8, 8), (-1, -1), stop)
    assert len(found) == 12
    np.testing.assert_allclose(found, expected, atol=0.05)
    assert np.abs((found - expected).mean(axis=0)).max() < 0.01


def test_the_black_of_a_marker_covers_its_projected_area():
    camera = CameraModel(200, 200, [[500, 0, 99.6], [0, 500, 98.9], [0, 0, 1]])
    body = RigidBody.create_single("4X4_50", 7, 0.04)
    view = RenderedView(camera, body)
    code = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 6
    )
    tilted = Pose([0.003, 0.001, 0.4], [np.cos(0.3), 0.0, np.sin(0.3), 0.0])
    for pose in (Pose([0.0, 0.0, 0.4], FACING), tilted):
        image = view.render(pose, SHARP)[50:150, 50:150].astype(float)
        corners = camera.project_points(pose.transform_points(body.corners[0])).astype(np.float32)
        margin = camera.project_points(pose.transform_points(body.corners[0] * 8 / 6)).astype(
            np.float32
        )
        # Within the white margin there are two greys only, so their mean tells the black area.
        inside = cv2.fillConvexPoly(
            np.zeros((200, 200)), np.int32(np.round(0.97 * margin + 0.03 * margin.mean(0))), 1
        )[50:150, 50:150]
        white, black = image[inside > 0].max(), image[inside > 0].min()
        area = ((white - image) * inside).sum() / (white - black)
        # Perspective shrinks far cells by as much as it enlarges near ones, but for 1 %.
        expected = cv2.contourArea(corners) * (code == 0).mean()
        assert area == pytest.approx(expected, rel=0.012)
