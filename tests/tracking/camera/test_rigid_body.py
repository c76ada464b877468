"""Bodies of markers and the files that describe them."""

import cv2
import numpy as np
import pytest

from us_sim.errors import TrackingError
from us_sim.tracking.camera.markers import load_dictionary
from us_sim.tracking.camera.rigid_body import RigidBody, read_rigid_body


def test_boards_are_where_opencv_has_them():
    board = cv2.aruco.GridBoard((4, 5), 0.0375, 0.005, load_dictionary("6X6_1000"))
    ours = RigidBody.create_grid("6X6_1000", columns=4, rows=5, size=0.0375, separation=0.005)
    assert np.allclose(ours.corners, np.array(board.getObjPoints()), atol=1e-7)
    assert np.array_equal(ours.ids, np.ravel(board.getIds()))


@pytest.mark.parametrize(
    ("make", "arguments", "word"),
    [
        (RigidBody.create_single, ("4X4_50", 50, 0.04), "0 to 49"),
        (RigidBody.create_single, ("8X8_50", 0, 0.04), "4X4_50"),
        (RigidBody.create_grid, ("4X4_50", 8, 7, 0.04, 0.01), "50"),
        (RigidBody.create_charuco, ("4X4_50", 5, 7, 0.02, 0.04), "smaller"),
    ],
)
def test_an_impossible_body_is_refused(make, arguments, word):
    with pytest.raises(TrackingError, match=word):
        make(*arguments)


def test_markers_are_placed_by_their_poses(tmp_path):
    path = tmp_path / "grip.yaml"
    path.write_text(
        """dictionary: APRILTAG_36h11
markers:
  - {id: 4, size: 30 mm, position: [10 mm, 0, 0], orientation: [0, 0.70710678, 0, 0.70710678]}
"""
    )
    body = read_rigid_body(path)
    assert np.allclose(body.corners[0, 0], [0.01, 0.015, 0.015])
    assert np.allclose(body.normals[0], [1.0, 0.0, 0.0])


def test_boards_are_read(tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text(
        "{dictionary: 6X6_250, board: {kind: charuco, columns: 5, rows: 7, square: 40 mm, "
        "size: 20 mm}}"
    )
    body = read_rigid_body(path)
    assert len(body.chessboard.corners) == 24
    assert np.allclose(body.chessboard.corners[0], [0.04, 0.04, 0.0])
    path.write_text(
        "dictionary: 4X4_50\n"
        "board: {kind: grid, columns: 2, rows: 1, size: 30 mm, separation: 6 mm, first: 7}"
    )
    assert read_rigid_body(path).ids.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{a: [", "YAML"),
        ("dictionary: 4X4_50", "markers"),
        ("{dictionary: 4X4_50, markers: [], sizes: 3}", "sizes"),
        ("markers: [{id: 1, size: 0.03}]", "dictionary"),
        ("{dictionary: 4X4_50, markers: [{id: 1, size: 30}]}", "30 mm"),
        ("{dictionary: 4X4_50, markers: [{id: 1, size: 0.03, position: 3}]}", "position"),
        (
            "{dictionary: 4X4_50, markers: [{id: 1, size: 0.03, orientation: [0, 0, 0, 0]}]}",
            "orientation",
        ),
        ("{dictionary: 4X4_50, board: {kind: grid, columns: 2}}", "board.rows"),
        ("{dictionary: 9X9, markers: [{id: 1, size: 0.03}]}", "9X9"),
    ],
)
def test_a_bad_file_is_refused(text, word, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(TrackingError, match=f"a.yaml: .*{word}"):
        read_rigid_body(path)
