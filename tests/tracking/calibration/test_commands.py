"""`us-sim calibrate` from end to end: a file that reads back, one line, and refusals."""

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from us_sim.command.main import main
from us_sim.geometry.pose import Pose
from us_sim.recording.path import ProbePath, write_path
from us_sim.tracking.calibration.transform_file import read_transform
from us_sim.tracking.camera.model import CameraModel, read_camera_info
from us_sim.tracking.camera.rendered_views import RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

TIP = np.array([0.01, -0.02, 0.12])


def calibrate(*arguments):
    return main(["calibrate", *map(str, arguments)])


def refusal(capsys, *arguments):
    """The one sentence with which a command ends with 1."""
    assert calibrate(*arguments) == 1
    error = capsys.readouterr().err.splitlines()
    [said] = [line for line in error if line.startswith("us-sim: ")]
    assert "Traceback" not in said
    return said


def bag(file, times, positions, rotations, frame="tracker"):
    stamps = (1_700_000_000 + np.asarray(times)) * 1e9
    path = ProbePath(
        "/tracker/pose",
        frame,
        np.round(stamps).astype(np.int64),
        np.asarray(positions),
        rotations.as_quat(),
    )
    write_path(file, path, sidecar=False)
    return file


def pivoting(file, axes=(1.0, 1.0, 0.3)):
    times = np.arange(0, 12, 0.05)
    turns = Rotation.from_rotvec(
        0.5 * np.stack([np.sin(times), np.cos(1.7 * times), np.sin(0.4 * times)], axis=1) * axes
    )
    return bag(file, times, [0.1, 0.2, 0.9] - turns.apply(TIP), turns)


def test_pivot_writes_the_tip(tmp_path, capsys):
    out = tmp_path / "tip.yaml"
    assert calibrate("pivot", pivoting(tmp_path / "pivot.mcap"), "--out", out) == 0
    np.testing.assert_allclose(read_transform(out).position, TIP, atol=1e-9)
    assert "tip at 10.00, -20.00, 120.00 mm" in capsys.readouterr().out
    assert yaml.safe_load(out.read_text())["residuals"]["rejected"] == 0


def test_pivot_refuses_one_axis_and_an_existing_file(tmp_path, capsys):
    rocked = pivoting(tmp_path / "rocked.mcap", axes=(1.0, 0.0, 0.0))
    out = tmp_path / "tip.yaml"
    assert "about one axis only" in refusal(capsys, "pivot", rocked, "--out", out)
    assert not out.exists()
    out.write_text("mine")
    assert "exists already" in refusal(capsys, "pivot", rocked, "--out", out)
    assert out.read_text() == "mine"
    assert "ends in .yaml" in refusal(capsys, "pivot", rocked, "--out", tmp_path / "tip.txt")
    assert "no bag" in refusal(capsys, "pivot", tmp_path / "x.mcap", "--out", tmp_path / "y.yaml")


POINTS = {"a": [0, 0, 0], "b": [0.1, 0, 0], "c": [0.1, 0.08, 0], "d": [0, 0.05, 0.03]}


def table(file, points):
    """A CSV file of landmarks."""
    rows = [",".join(map(str, [name, *point])) for name, point in points.items()]
    file.write_text("\n".join(["name,x,y,z", *rows]))
    return file


def test_landmarks_are_matched_by_name(tmp_path, capsys):
    pose = Pose([0.3, -0.2, 0.5], [0.1, 0.2, 0.3, 0.9])
    measured = {
        name: pose.inverse().transform_points(np.array([point]))[0]
        for name, point in reversed(POINTS.items())
    }
    measured["elbow"] = [0, 0, 0]
    known = table(tmp_path / "known.csv", POINTS)
    out = tmp_path / "registration.yaml"
    assert calibrate("landmarks", known, table(tmp_path / "m.csv", measured), "--out", out) == 0
    np.testing.assert_allclose(read_transform(out).matrix, pose.matrix, atol=1e-9)
    said = yaml.safe_load(out.read_text())
    assert (said["from"], said["to"]) == ("tracker", "patient")
    assert set(said["residuals"]["landmarks"]) == set(POINTS)
    said = capsys.readouterr().out
    assert "FRE 0.00 mm over 4 landmarks" in said
    assert "in one file only: elbow" in said
    inverse = tmp_path / "calibration.yaml"
    options = ("--invert", "--to", "probe", "--out", inverse)
    assert calibrate("landmarks", known, tmp_path / "m.csv", *options) == 0
    np.testing.assert_allclose(read_transform(inverse).matrix, pose.inverse().matrix, atol=1e-9)
    said = yaml.safe_load(inverse.read_text())
    assert (said["from"], said["to"]) == ("probe", "tracker")


def test_landmarks_are_touched_in_a_recording(tmp_path):
    # Two seconds on each, tilting; one on the way between them.
    tips, angles = [], []
    for point in POINTS.values():
        tips += [np.add(point, [0, 0, 0.02 * (10 - k)]) for k in range(10)] + [point] * 40
        angles += [0.0] * 10 + list(0.4 * np.sin(np.linspace(0, 6, 40)))
    turns = Rotation.from_euler("x", np.array(angles)[:, None])
    pose = Pose([0.3, -0.2, 0.5], [0.1, 0.2, 0.3, 0.9])
    placed = Rotation.from_quat(pose.inverse().orientation) * turns
    positions = pose.inverse().transform_points(np.array(tips, float)) - placed.apply(TIP)
    recording = bag(tmp_path / "stylus.mcap", 0.05 * np.arange(len(tips)), positions, placed)
    known, tip = table(tmp_path / "known.csv", POINTS), tmp_path / "tip.yaml"
    tip.write_text(yaml.safe_dump({"position": TIP.tolist(), "orientation": [0, 0, 0, 1]}))
    out = tmp_path / "registration.yaml"
    assert calibrate("landmarks", known, recording, "--tip", tip, "--out", out) == 0
    np.testing.assert_allclose(read_transform(out).matrix, pose.matrix, atol=1e-6)


def test_landmarks_on_a_line_are_refused(tmp_path, capsys):
    line = {name: [0.05 * k, 0, 0] for k, name in enumerate("abcd")}
    known = table(tmp_path / "line.csv", line)
    out = ("--out", tmp_path / "r.yaml")
    assert "lie on a line" in refusal(capsys, "landmarks", known, known, *out)
    other = table(tmp_path / "other.csv", {"x": [0, 0, 0]})
    assert "share no landmark's name" in refusal(capsys, "landmarks", known, other, *out)
    recording = pivoting(tmp_path / "pivot.mcap")
    assert "give --tip FILE" in refusal(capsys, "landmarks", known, recording, *out)


def test_time_of_two_bags(tmp_path, capsys):
    def stroke(times):
        return np.outer(np.sin(5 * times + np.sin(0.7 * times)), [0.01, 0.02, 0.0])

    slow, fast = np.arange(1, 19, 0.08), np.arange(0, 20, 0.02)
    still = Rotation.identity
    moving = bag(tmp_path / "moving.mcap", fast - 0.05, stroke(fast), still(len(fast)))
    fixed = bag(tmp_path / "fixed.mcap", slow, stroke(slow), still(len(slow)))
    out = tmp_path / "time.yaml"
    assert calibrate("time", moving, fixed, "--out", out) == 0
    written = yaml.safe_load(out.read_text())
    assert written["time_offset"] == pytest.approx(0.05, abs=1e-4)
    assert written["standard_deviation"] < 1e-4
    assert "time_offset 50.0 ms" in capsys.readouterr().out
    assert "exists already" in refusal(capsys, "time", moving, fixed, "--out", out)


def board_file(tmp_path, dictionary_and_board):
    file = tmp_path / "board.yaml"
    file.write_text(f"{{dictionary: {dictionary_and_board}}}")
    return file


@pytest.mark.slow
def test_camera_from_photos_of_a_board(tmp_path, capsys):
    # Rendered by a pinhole of 700 pixels, 640 × 480, from six sides.
    camera = CameraModel(640, 480, [[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    board = RigidBody.create_charuco("4X4_50", 9, 7, 0.02, 0.015)
    view = RenderedView(camera, board)
    tilts = [[0.4, 0, 0], [-0.4, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0.3, 0.3, 0.2], [-0.3, 0.3, 0]]
    for k, tilt in enumerate(tilts):
        turn = Rotation.from_rotvec(tilt)
        place = np.array([0.02 * (k % 3 - 1), 0.02 * (k % 2), 0.3]) - turn.apply([0.09, 0.07, 0])
        cv2.imwrite(str(tmp_path / f"{k}.png"), view.render(Pose(place, turn.as_quat())))
    blank = tmp_path / "10.png"
    cv2.imwrite(str(blank), np.full((480, 640), 120, np.uint8))
    out = tmp_path / "out.yaml"
    sizes = "columns: 9, rows: 7, square: 20 mm, size: 15 mm"
    options = (board_file(tmp_path, f"4X4_50, board: {{kind: charuco, {sizes}}}"), tmp_path)
    assert calibrate("camera", *options, "--name", "webcam", "--out", out) == 0
    said = capsys.readouterr().out
    assert "in 6 photos" in said
    assert "1 without the board: 10.png" in said
    found = read_camera_info(out)
    np.testing.assert_allclose(found.matrix, camera.matrix, atol=1.0)
    written = yaml.safe_load(out.read_text())
    assert written["camera_name"] == "webcam"
    assert written["residuals"]["rms"] < 0.1
    assert list(written["residuals"]["photos"]) == [f"{k}.png" for k in range(6)]


def test_camera_refuses_what_is_no_photo_or_board(tmp_path, capsys):
    sizes = "columns: 5, rows: 7, square: 40 mm, size: 20 mm"
    board = board_file(tmp_path, f"6X6_250, board: {{kind: charuco, {sizes}}}")
    photos = ("camera", board, tmp_path, "--out", tmp_path / "c.yaml")
    assert "no such photo" in refusal(capsys, *photos)
    text = tmp_path / "text.jpg"
    text.write_text("no image")
    assert "is no image" in refusal(capsys, *photos)
    text.unlink()
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    assert "none of the 1 photos shows" in refusal(capsys, *photos)
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((60, 90), np.uint8))
    assert "has 90 × 60 pixels" in refusal(capsys, *photos)
