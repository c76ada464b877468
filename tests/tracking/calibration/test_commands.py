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
from us_sim.tracking.camera.model import read_camera_info

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


POSED = "feature,column,row,x,y,z,qx,qy,qz,qw"


def sheet(file, header, rows):
    """A CSV file of numbers and names."""
    lines = [",".join(map(str, row)) for row in rows]
    file.write_text("\n".join([header, *lines]))
    return file


def table(file, points):
    return sheet(file, "name,x,y,z", [[name, *point] for name, point in points.items()])


def test_landmarks_are_matched_by_name(tmp_path, capsys):
    pose = Pose([0.3, -0.2, 0.5], [0.1, 0.2, 0.3, 0.9])
    measured = {
        name: pose.inverse().apply(np.array([point]))[0] for name, point in reversed(POINTS.items())
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
    positions = pose.inverse().apply(np.array(tips, float)) - placed.apply(TIP)
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
    assert cv2.imread(str(out.with_suffix(".png"))) is not None
    assert "exists already" in refusal(capsys, "time", moving, fixed, "--out", out)


def test_probe_from_times_and_from_poses(tmp_path, capsys):
    rng = np.random.default_rng(0)
    times = np.arange(0, 40, 0.1)
    turns = Rotation.from_rotvec(0.6 * np.stack([np.sin(k * times + k) for k in (1, 2, 3)], axis=1))
    spacing, corner, pin = 2e-4, np.array([0.01, 0.02, 0.06]), [0.1, 0.2, 0.3]
    pixels = np.round(rng.uniform(50, 450, (len(times), 2)), 3)
    body = corner + spacing * np.stack([pixels[:, 0], 0 * times, pixels[:, 1]], axis=1)
    positions = pin - turns.apply(body)
    recording = bag(tmp_path / "probe.mcap", times, positions, turns)
    chosen = [*range(0, 395, 5), 399]  # the first pose and the last among them
    stamped = [["pin", *pixels[k], f"{1_700_000_000 + times[k]:.3f}"] for k in chosen]
    timed = sheet(tmp_path / "timed.csv", "feature,column,row,time", stamped)
    placed = [["pin", *pixels[k], *positions[k], *turns[k].as_quat()] for k in chosen]
    posed = sheet(tmp_path / "posed.csv", POSED, placed)
    phantom = table(tmp_path / "phantom.csv", {"pin": pin})
    first, second = tmp_path / "timed.yaml", tmp_path / "posed.yaml"
    origin = ("--origin", 250, 0)
    known = ("--recording", recording, "--phantom", phantom)
    assert calibrate("probe", timed, *known, *origin, "--out", first) == 0
    assert calibrate("probe", posed, *origin, "--out", second) == 0
    assert "pixels of 0.2000 × 0.2000 mm" in capsys.readouterr().out
    expected = np.add(corner, [250 * spacing, 0.0, 0.0])
    # Stamps of seconds since 1970 are held to a quarter of a microsecond.
    np.testing.assert_allclose(read_transform(first).position, expected, atol=1e-6)
    np.testing.assert_allclose(read_transform(first).orientation, [0, 0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(read_transform(second).position, expected, atol=1e-9)
    np.testing.assert_allclose(yaml.safe_load(second.read_text())["points"]["pin"], pin, atol=1e-9)
    other = table(tmp_path / "other.csv", {"wire": pin})
    said = refusal(capsys, "probe", posed, "--phantom", other, *origin, "--out", "x.yaml")
    assert "has no pin, which" in said


@pytest.mark.parametrize("time", ["1699999999.9", "1700000004.1", "1700000002.25"])
def test_sightings_without_a_pose_are_refused(tmp_path, capsys, time):
    times = np.concatenate([np.arange(0, 2.05, 0.1), np.arange(2.5, 4.05, 0.1)])
    turns = Rotation.from_euler("x", times[:, None])
    recording = bag(tmp_path / "probe.mcap", times, np.zeros((len(times), 3)), turns)
    (tmp_path / "seen.csv").write_text(f"feature,column,row,time\npin,100,200,{time}\n")
    chosen = ("--recording", recording, "--origin", 0, 0, "--out", tmp_path / "x.yaml")
    assert "no pose around" in refusal(capsys, "probe", tmp_path / "seen.csv", *chosen)


def test_probe_that_hardly_turned_over_few_wires_is_remarked_on(tmp_path, capsys):
    rng = np.random.default_rng(3)
    wires = {f"w{k}": [0.02 * k, 0, 0.01 * k**2, 0.02 * (k + 1), 0.04, 0.01] for k in range(4)}
    ends_of = [[name, *ends] for name, ends in wires.items()]
    phantom = sheet(tmp_path / "wires.csv", "name,x1,y1,z1,x2,y2,z2", ends_of)
    rows = []
    for k in range(80):
        name = f"w{k % 4}"
        ends = np.reshape(wires[name], (2, 3))
        place = ends[0] + rng.uniform(0.1, 0.9) * (ends[1] - ends[0])
        pixel = rng.uniform(50, 450, 2)
        turn = Rotation.from_rotvec(np.radians(3.0) * rng.uniform(-0.5, 0.5, 3))
        body = turn.apply([0.01 + 2e-4 * pixel[0], 0.02, 0.06 + 2e-4 * pixel[1]])
        rows.append([name, *pixel, *(place - body), *turn.as_quat()])
    out = tmp_path / "probe.yaml"
    chosen = ("--phantom", phantom, "--origin", 250, 0, "--out", out)
    assert calibrate("probe", sheet(tmp_path / "seen.csv", POSED, rows), *chosen) == 0
    said = capsys.readouterr().out
    assert "the probe turned by only 4°, which determines little" in said
    assert "4 features are too few" in said
    assert "the image's edge is known" not in said  # sighted without errors
    written = yaml.safe_load(out.read_text())
    assert np.radians(2.5) < written["residuals"]["turned"] < np.radians(5.2)
    assert written["standard_deviations"]["clusters"] == 12
    assert written["standard_deviations"]["cluster"] == "part of a feature's sightings"
    assert written["standard_deviations"]["edge"] < 1e-5
    for row in rows:
        row[3:6] += rng.normal(0.0, 3e-3, 3)
    out = tmp_path / "noisy.yaml"
    seen = sheet(tmp_path / "noisy.csv", POSED, rows)
    assert calibrate("probe", seen, *chosen[:-1], out) == 0
    assert "the image's edge is known to ± " in capsys.readouterr().out


def test_camera_from_photos_of_a_chessboard(tmp_path, capsys):
    # Rendered by a pinhole of 700 pixels, 640 × 480, from six sides.
    squares = np.add.outer(np.arange(7), np.arange(9)) % 2 * 255
    print_ = cv2.copyMakeBorder(
        np.kron(squares, np.ones((40, 40))).astype(np.uint8), 40, 40, 40, 40, 0, value=255
    )
    camera = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    tilts = [[0.4, 0, 0], [-0.4, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0.3, 0.3, 0.2], [-0.3, 0.3, 0]]
    for k, tilt in enumerate(tilts):
        rotation = Rotation.from_rotvec(tilt).as_matrix()
        place = [0.02 * (k % 3 - 1), 0.02 * (k % 2), 0.42] - rotation @ [0.11, 0.09, 0]
        # From print's pixels (40 of a square of 20 mm) to metres to the image.
        metres = np.array([[5e-4, 0, 0], [0, 5e-4, 0], [0, 0, 1.0]])
        homography = camera @ np.column_stack([rotation[:, :2], place]) @ metres
        image = cv2.warpPerspective(print_, homography, (640, 480), borderValue=120)
        cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.GaussianBlur(image, (3, 3), 0))
    blank = tmp_path / "10.png"
    cv2.imwrite(str(blank), np.full((480, 640), 120, np.uint8))
    out = tmp_path / "out.yaml"
    board = ("--board", "chessboard", "--size", "9x7", "--square", "20 mm")
    assert calibrate("camera", tmp_path, *board, "--out", out, "--name", "webcam") == 0
    said = capsys.readouterr().out
    assert "in 6 photos" in said
    assert "1 without the board: 10.png" in said
    found = read_camera_info(out)
    np.testing.assert_allclose(found.matrix, camera, atol=6.0)
    written = yaml.safe_load(out.read_text())
    assert written["camera_name"] == "webcam"
    assert written["residuals"]["rms"] < 0.3
    assert list(written["residuals"]["photos"]) == [f"{k}.png" for k in range(6)]
    assert cv2.imread(str(out.with_suffix(".png"))) is not None


def test_camera_refuses_what_is_no_photo_or_board(tmp_path, capsys):
    board = ("--size", "5x7", "--square", "40 mm", "--marker", "20 mm", "--dictionary", "6X6_250")
    out = ("--out", tmp_path / "c.yaml")
    assert "no such photo" in refusal(capsys, "camera", tmp_path / "*.jpg", *board, *out)
    text = tmp_path / "text.jpg"
    text.write_text("no image")
    assert "is no image" in refusal(capsys, "camera", text, *board, *out)
    text.unlink()
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    assert "none of the 1 photos shows" in refusal(capsys, "camera", tmp_path, *board, *out)
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((60, 90), np.uint8))
    assert "has 90 × 60 pixels" in refusal(capsys, "camera", tmp_path, *board, *out)
    assert "write columns and rows, e.g. 5x7" in refusal(
        capsys, "camera", tmp_path, "--size", "5by7", *out
    )
