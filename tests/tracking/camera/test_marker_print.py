"""Printed sheets have their true size, and are found again."""

import struct

import cv2
import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.errors import TrackingError
from us_sim.share import shared_path
from us_sim.tracking.camera.fiducial_detector import FiducialDetector
from us_sim.tracking.camera.marker_print import lay_out_sheets, print_markers
from us_sim.tracking.camera.rigid_body import RigidBody


def dots_per_metre(path):
    content = path.read_bytes()
    at = content.index(b"pHYs") + 4
    across, down, unit = struct.unpack(">IIB", content[at : at + 9])
    assert (across, unit) == (down, 1)
    return across


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        RigidBody.create_single("APRILTAG_36h11", 7, 0.04),
        RigidBody.create_grid("6X6_1000", 4, 5, 0.0375, 0.005),
        RigidBody.create_charuco("6X6_250", 5, 7, 0.03, 0.015),
        RigidBody.create_charuco("5X5_250", 6, 8, 0.025, 0.018),
        RigidBody.create_charuco("5X5_250", 6, 8, 0.025, 0.018, legacy=True),
    ],
)
def test_a_printed_body_has_its_size(body, tmp_path):
    path = tmp_path / "sheet.png"
    print_markers(body, path)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    points, pixels, _ = FiducialDetector(body).detect_markers(image).match_points(body)
    wanted = len(body.ids) * 4 if body.chessboard is None else len(body.chessboard.corners)
    assert len(points) == wanted
    printed = pixels / dots_per_metre(path)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    shape, *_ = np.linalg.lstsq(design, printed, rcond=None)
    assert np.allclose(np.abs(shape[:2]), np.eye(2), atol=5e-4)
    assert np.abs(design @ shape - printed).max() < 0.03e-3


def test_markers_of_a_body_that_is_not_flat_are_printed_one_by_one():
    corners = np.concatenate([RigidBody.create_single("4X4_50", 0, 0.05).corners] * 20)
    corners += np.arange(20.0)[:, None, None] * [0.0, 0.0, 0.01]
    pages = lay_out_sheets(RigidBody("4X4_50", np.arange(20), corners))
    # With their margins two of 66.7 mm go beside each other, and three of these rows on a sheet.
    numbers = [list(range(first, min(first + 6, 20))) for first in (0, 6, 12, 18)]
    assert [[int(text) for *_, text in page.labels] for page in pages] == numbers
    for page in pages:
        edges = np.roll(page.marked, -1, axis=1) - page.marked
        assert np.allclose(np.linalg.norm(edges, axis=2), 50.0)


def test_a_pdf_has_the_papers_size_and_the_markers_as_outlines(tmp_path):
    path = tmp_path / "sheet.pdf"
    print_markers(RigidBody.create_single("4X4_50", 7, 0.04), path, "letter")
    content = path.read_bytes()
    assert b"/MediaBox [ 0 0 612 792 ]" in content
    assert b"/Subtype /Image" not in content


def test_nothing_is_overwritten_and_what_cannot_be_is_said(tmp_path):
    marker = RigidBody.create_single("4X4_50", 7, 0.04)
    path = tmp_path / "sheet.png"
    path.write_bytes(b"kept")
    large = RigidBody.create_grid("4X4_50", 5, 7, 0.04, 0.01)
    for body, name, paper, word in (
        (marker, "sheet.png", "A4", "exists"),
        (marker, "sheet.jpg", "A4", ".pdf"),
        (marker, "other.png", "B5", "letter"),
        (large, "other.png", "A4", "190 × 255"),
    ):
        with pytest.raises(TrackingError, match=word):
            print_markers(body, tmp_path / name, paper)
    assert path.read_bytes() == b"kept"
    assert [each.name for each in tmp_path.iterdir()] == ["sheet.png"]


def test_the_command_prints(tmp_path, capsys):
    board = shared_path("config/markers/board.yaml")
    out = tmp_path / "board.png"
    assert main(["print-marker", str(board), "--out", str(out)]) == 0
    assert "ChArUco 5x7, squares 30 mm, markers 22 mm, 4X4_50; 1 sheet of A4" in (
        capsys.readouterr().out
    )
    assert out.exists()
    grip = shared_path("config/markers/probe_grip.yaml")
    assert main(["print-marker", str(grip), "--out", str(tmp_path / "grip.pdf")]) == 0
    assert "4X4_50, 0, 1, 2, 3, 4, 5: 30 mm" in capsys.readouterr().out
    assert (
        main(["print-marker", str(board), "--paper", "A5", "--out", str(tmp_path / "a.pdf")]) == 1
    )
    assert "letter" in capsys.readouterr().err
