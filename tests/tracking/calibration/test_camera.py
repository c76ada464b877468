"""Cameras from boards: known cameras, real photos, error statistics, and refusals."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.tracking.calibration.camera import BoardView, calibrate_camera, find_board
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import RigidBody

CAMERA = CameraModel(
    640, 480, [[610.0, 0, 325], [0, 612, 236], [0, 0, 1]], [-0.21, 0.06, 1e-3, -5e-4, 0.0]
)
CORNERS = 0.03 * np.stack([*np.indices((9, 7)), np.zeros((9, 7))], axis=-1).reshape(-1, 3)


def view(turn, place, noise=0.0, rng=None):
    seen = Rotation.from_rotvec(turn).apply(CORNERS - CORNERS.mean(axis=0)) + place
    pixels = CAMERA.project_points(seen)
    if rng is not None:
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
    return BoardView(CORNERS.astype(np.float32), pixels.astype(np.float32))


def good_views(rng, count=12, noise=0.2):
    return [
        view(
            0.5 * rng.standard_normal(3),
            [rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.35, 0.5)],
            noise,
            rng,
        )
        for _ in range(count)
    ]


def test_exact_views_give_the_camera():
    found = calibrate_camera(good_views(np.random.default_rng(0), noise=0.0), 640, 480)
    np.testing.assert_allclose(found.camera.matrix, CAMERA.matrix, atol=0.05)
    np.testing.assert_allclose(found.camera.distortion, CAMERA.distortion, atol=3e-3)
    assert found.rms < 1e-3
    assert found.note == ""


def test_errors_are_as_large_as_the_deviations_say():
    rng = np.random.default_rng(5)
    true = np.array([610, 612, 325, 236, *CAMERA.distortion])
    normal, rms = [], []
    for _ in range(25):
        found = calibrate_camera(good_views(rng), 640, 480)
        matrix = found.camera.matrix
        numbers = [matrix[0, 0], matrix[1, 1], *matrix[:2, 2], *found.camera.distortion]
        normal.append((numbers - true) / found.deviations)
        rms.append(found.rms)
    # 225 deviates of which some go together: their root mean square scatters by about 0.1.
    assert np.sqrt(np.mean(np.square(normal))) == pytest.approx(1.0, abs=0.25)
    # Two coordinates of 0.2 pixels each, less what 9 + 6 parameters a view fit away.
    assert np.mean(rms) == pytest.approx(0.2 * np.sqrt(2), rel=0.06)


@pytest.mark.slow
def test_the_grid_boards_photos_give_a_smaller_residual_than_was_known(shared_data):
    board = RigidBody.create_grid("DICT_6X6_1000", 4, 5, 0.0375, 0.005)
    files = [shared_data / "marker-aruco-gridboard" / f"{k}.jpg" for k in range(42)]
    views = [find_board(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), board) for file in files]
    # At least 19 of the 20 markers in each photo, as other programs find.
    assert min(len(view) for view in views) >= 4 * 19
    found = calibrate_camera(views, 640, 480)
    assert found.rms < 0.3  # 0.918 pixels without sub-pixel corners, 0.46 with OpenCV's
    # OpenCV's own result there: 813.3, 812.8, 319.0, 239.5; five deviations of it apart.
    focal_and_centre = found.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    np.testing.assert_allclose(focal_and_centre, [813.3, 812.8, 319.0, 239.5], atol=5.0)
    assert (found.deviations[:4] < 1.2).all()


def test_the_charuco_photos_give_the_published_camera(shared_data):
    board = RigidBody.create_charuco("6X6_250", 5, 7, 0.04, 0.02)
    files = [shared_data / "marker-opencv-charuco" / f"img_0{k}.jpg" for k in range(4)]
    views = [find_board(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), board) for file in files]
    assert [len(view) for view in views] == [24, 24, 24, 24]
    found = calibrate_camera(views, 640, 480)
    assert found.rms <= 0.15  # OpenCV's corners give 0.19
    # tutorial_camera_charuco.yml of OpenCV, within the errors that four alike views leave to both.
    published = np.array([452.511, 456.767, 317.703, 277.752])
    error = found.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - published
    assert (np.abs(error) < 2.5 * found.deviations[:4]).all()
    assert "the focal length is known to 2." in found.note
    assert "beyond 44 % of the way" in found.note


def test_a_photo_with_wrong_corners_is_left_out():
    rng = np.random.default_rng(3)
    views = good_views(rng)
    wrong = views[4].pixels + np.float32(6.0) * rng.standard_normal((63, 2)).astype(np.float32)
    views[4] = BoardView(views[4].points, wrong)
    found = calibrate_camera(views, 640, 480)
    assert (found.used == (np.arange(12) != 4)).all()
    assert found.rms < 0.4
    assert len(found.residuals) == 11


def parallel_views(rng):
    return [
        view([0.0, 0.0, 0.3 * k], [0.1 - 0.05 * k, 0.02 * k, 0.3 + 0.05 * k], 0.2, rng)
        for k in range(6)
    ]


def middle_views(rng):
    return [view(0.5 * rng.standard_normal(3), [0, 0, 1.4], 0.1, rng) for _ in range(12)]


def stretched_views(rng):
    """Of corners that lie as on no plane board whose camera is a pinhole."""
    stretch = np.float32([1, 1.4, 1])
    return [BoardView(stretch * view.points**2, view.pixels) for view in good_views(rng)]


@pytest.mark.parametrize(
    ("views", "problem"),
    [
        (parallel_views, "all parallel"),
        (middle_views, "in the middle"),
        (stretched_views, "no camera fits"),
        (lambda rng: good_views(rng, 2), "in 2 photos"),
    ],
)
def test_views_that_do_not_determine_the_camera_are_refused(views, problem):
    with pytest.raises(CalibrationError, match=problem):
        calibrate_camera(views(np.random.default_rng(1)), 640, 480)


def drawn(board):
    """A photo straight from above, 100 pixels a square."""
    columns, rows = board.chessboard.columns, board.chessboard.rows
    image = board.chessboard.board.generateImage((100 * columns, 100 * rows))
    return cv2.copyMakeBorder(image, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)


@pytest.mark.slow
def test_half_a_board_is_enough_and_a_row_or_none_of_it_is_not():
    board = RigidBody.create_charuco("4X4_50", 6, 5, 0.03, 0.02)
    photo = drawn(board)
    whole, half = find_board(photo, board), find_board(photo[:, :400], board)
    assert len(whole) == 20
    assert 6 <= len(half) < 20
    # The squares are 100 pixels and 30 mm wide.
    scale = np.polyfit(half.points[:, 0], half.pixels[:, 0], 1)[0]
    assert scale == pytest.approx(100 / 0.03, rel=2e-3)
    assert find_board(photo[:, :200], board) is None
    assert find_board(np.zeros((100, 100), np.uint8), board) is None
