"""Cameras from boards: known cameras, real photos, error statistics, and refusals."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.tracking.calibration.camera import Board, BoardView, calibrate_camera
from us_sim.tracking.camera.model import CameraModel

CAMERA = CameraModel(
    640, 480, [[610.0, 0, 325], [0, 612, 236], [0, 0, 1]], [-0.21, 0.06, 1e-3, -5e-4, 0.0]
)
CORNERS = 0.03 * np.stack([*np.indices((9, 7)), np.zeros((9, 7))], axis=-1).reshape(-1, 3)


def view(turn, place, noise=0.0, rng=None):
    seen = Rotation.from_rotvec(turn).apply(CORNERS - CORNERS.mean(axis=0)) + place
    pixels = CAMERA.project(seen)
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


def test_the_grid_boards_photos_give_a_smaller_residual_than_was_known(shared_data):
    board = Board("grid", 4, 5, marker=0.0375, separation=0.005, dictionary="DICT_6X6_1000")
    files = [shared_data / "marker-aruco-gridboard" / f"{k}.jpg" for k in range(42)]
    views = [board.find(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) for file in files]
    # At least 19 of the 20 markers in each photo, as other programs find.
    assert min(len(view) for view in views) >= 4 * 19
    found = calibrate_camera(views, 640, 480)
    assert found.rms < 0.5  # 0.918 pixels without sub-pixel corners
    # OpenCV's own result there: 813.3, 812.8, 319.0, 239.5; five deviations of it apart.
    focal_and_centre = found.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    np.testing.assert_allclose(focal_and_centre, [813.3, 812.8, 319.0, 239.5], atol=5.0)
    assert (found.deviations[:4] < 1.2).all()


def test_the_charuco_photos_give_the_published_camera(shared_data):
    board = Board("charuco", 5, 7, 0.04, 0.02, dictionary="6X6_250")
    files = [shared_data / "marker-opencv-charuco" / f"img_0{k}.jpg" for k in range(4)]
    views = [board.find(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) for file in files]
    assert [len(view) for view in views] == [24, 24, 24, 24]
    found = calibrate_camera(views, 640, 480)
    assert found.rms <= 0.20
    # tutorial_camera_charuco.yml of OpenCV, within the deviations that four alike views leave.
    published = np.array([452.511, 456.767, 317.703, 277.752])
    error = found.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - published
    assert (np.abs(error) < found.deviations[:4]).all()
    assert "the focal length is known to 3." in found.note
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


def test_half_a_chessboard_is_not_a_board_but_half_a_charuco_is():
    board = Board("charuco", 6, 5, 0.03, 0.02, dictionary="4X4_50")
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((6, 5), 0.03, 0.02, markers).generateImage((600, 500))
    photo = cv2.copyMakeBorder(drawn, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    whole, half = board.find(photo), board.find(photo[:, :400])
    assert len(whole) == 20
    assert 6 <= len(half) < 20
    # The squares are 100 pixels and 30 mm wide.
    scale = np.polyfit(half.points[:, 0], half.pixels[:, 0], 1)[0]
    assert scale == pytest.approx(100 / 0.03, rel=2e-3)
    squares = np.add.outer(np.arange(5), np.arange(6)) % 2 * 255
    chessboard = np.kron(squares, np.ones((60, 60))).astype(np.uint8)
    chessboard = cv2.copyMakeBorder(chessboard, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    plain = Board("chessboard", 6, 5, 0.03)
    assert len(plain.find(chessboard)) == 20
    assert plain.find(chessboard[:, :250]) is None
    assert plain.find(np.zeros((100, 100), np.uint8)) is None


def test_old_charuco_boards_need_to_be_called_that():
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    old = cv2.aruco.CharucoBoard((5, 6), 0.03, 0.02, markers)
    old.setLegacyPattern(True)
    photo = cv2.copyMakeBorder(old.generateImage((400, 480)), 60, 60, 60, 60, 0, value=255)
    arguments = ("charuco", 5, 6, 0.03, 0.02, 0.0, "4X4_50")
    assert Board(*arguments).find(photo) is None
    assert len(Board(*arguments, legacy=True).find(photo)) == 20


def test_a_large_chessboard_is_found_as_exactly_as_a_small_one():
    squares = np.add.outer(np.arange(7), np.arange(9)) % 2 * 255
    photo = np.kron(squares, np.ones((240, 240))).astype(np.uint8)
    photo = cv2.copyMakeBorder(photo, 400, 400, 400, 400, 0, value=200)
    found = Board("chessboard", 9, 7, 0.02).find(photo)
    # Corners lie between pixels; their middle is the board's.
    np.testing.assert_allclose(
        found.pixels.mean(axis=0), [399.5 + 4.5 * 240, 399.5 + 3.5 * 240], atol=0.05
    )
    steps = np.linalg.norm(np.diff(found.pixels.reshape(6, 8, 2), axis=1), axis=2)
    np.testing.assert_allclose(steps, 240.0, atol=0.2)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("circles", 5, 7, 0.04), "there is no board 'circles'"),
        (("charuco", 2, 7, 0.04, 0.02, 0.0, "6X6_250"), "too few corners"),
        (("charuco", 5, 7, 0.04), "needs its marker"),
        (("charuco", 5, 7, 0.04, 0.02), "needs the dictionary of its markers"),
        (("charuco", 5, 7, 0.04, 0.05, 0.0, "6X6_250"), "must be smaller than its square"),
        (("grid", 5, 7, 0.0, 0.03, 0.005, "7X3_1"), "no marker dictionary '7X3_1'"),
        (("chessboard", 5, 7, 40.0), "needs its square in metres"),
    ],
)
def test_boards_that_cannot_be_are_refused(arguments, problem):
    with pytest.raises(CalibrationError, match=problem):
        Board(*arguments)
