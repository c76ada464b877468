"""Two sessions that are apart by known amounts."""

import csv

import numpy as np
import pytest
from session_files import EPOCH, PERIOD, cloud, image, pose, press, wrench, write

from us_sim.command.main import main
from us_sim.recording.reader import read_bag
from us_sim.run.session_diff import HEAD, diff, table

IMAGE, NODES, POSE, WRENCH = "/ultrasound/image", "/tissue/nodes", "/probe/pose", "/probe/wrench"


def changed(tmp_path, change):
    messages = press(60)
    one = write(tmp_path / "a.mcap", messages)
    change(messages)
    other = write(tmp_path / "b.mcap", messages)
    found = diff(read_bag(one), read_bag(other))
    return found, {row[:2]: dict(zip(HEAD, row, strict=True)) for row in found.rows}


def put(messages, topic, number, data):
    message = [each for each in messages if each[0] == topic][number]
    message[1] = bytes(data)


def stamp(number):
    return EPOCH + number * PERIOD


def test_a_session_and_its_copy_are_equal(tmp_path, capsys):
    messages = press(60)
    files = [str(write(tmp_path / name, messages)) for name in ("a.mcap", "b.mcap")]
    assert main(["bag", "diff", *files, "--out", str(tmp_path / "out")]) == 0
    assert "all 240 pairs are equal" in capsys.readouterr().out


def test_poses_differ_by_millimetres_and_degrees(tmp_path):
    def move(messages):
        depth = 0.008 * np.sin(np.pi * 30 / 60)
        half = np.cos(np.radians(10) / 2)
        put(messages, POSE, 30, pose(stamp(30), depth + 0.004, 0.003, half))

    found, rows = changed(tmp_path, move)
    assert not found.is_none
    position, angle = rows[POSE, "position (mm)"], rows[POSE, "angle (°)"]
    assert (position["pairs"], position["same"], position["median"]) == ("60", "59", "0")
    assert float(position["worst"]) == pytest.approx(5.0)  # of 3 and 4 mm
    assert float(angle["worst"]) == pytest.approx(10.0)
    assert position["at (s)"] == "0.500"


def test_nodes_differ_by_their_distance(tmp_path):
    nodes = np.arange(12.0).reshape(4, 3) * 1e-2 + [0, 0, 0.008 * np.sin(np.pi * 20 / 60)]

    def move(messages):
        there = nodes.copy()
        there[2] += [0.0006, 0, 0.0008]
        put(messages, NODES, 20, cloud(stamp(20), there))

    rows = changed(tmp_path, move)[1]
    assert float(rows[NODES, "nodes, worst (mm)"]["worst"]) == pytest.approx(1.0, rel=1e-3)
    assert float(rows[NODES, "nodes, rms (mm)"]["worst"]) == pytest.approx(0.5, rel=1e-3)


def test_wrenches_differ_by_newtons(tmp_path):
    def press_less(messages):
        force = -8.0 * np.sin(np.pi * 10 / 60)
        put(messages, WRENCH, 10, wrench(stamp(10), force + 0.25))

    rows = changed(tmp_path, press_less)[1]
    assert float(rows[WRENCH, "force (N)"]["worst"]) == pytest.approx(0.25)
    assert rows[WRENCH, "torque (N mm)"]["worst"] == "0"


def test_images_differ_by_grey_levels(tmp_path, capsys):
    ramp = np.add.outer(np.arange(8), np.arange(6)).astype(np.uint8)

    def brighten(messages):
        put(messages, IMAGE, 5, image(stamp(5), ramp + 5 + 3))
        one_pixel = ramp + 6
        one_pixel[0, 0] += 200
        put(messages, IMAGE, 6, image(stamp(6), one_pixel))

    found, rows = changed(tmp_path, brighten)
    mean, worst = rows[IMAGE, "grey levels, mean"], rows[IMAGE, "grey levels, worst"]
    assert float(mean["worst"]) == pytest.approx(200 / 48, rel=1e-3)
    assert (worst["worst"], worst["same"]) == ("200", "58")
    files = [str(tmp_path / name) for name in ("a.mcap", "b.mcap")]
    assert main(["bag", "diff", *files, "--out", str(tmp_path / "out")]) == 1
    assert IMAGE in capsys.readouterr().out
    with (tmp_path / "out" / "diff.csv").open(encoding="utf-8") as stream:
        assert [tuple(row) for row in csv.reader(stream)] == [HEAD, *found.rows]
    assert main(["bag", "diff", *files, "--out", str(tmp_path / "out")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_messages_without_a_pair_are_counted_and_differ(tmp_path):
    def lose(messages):
        for number in (50, 40, 7):
            messages.remove([each for each in messages if each[0] == NODES][number])

    found, rows = changed(tmp_path, lose)
    row = rows[NODES, "nodes, rms (mm)"]
    assert (row["pairs"], row["same"], row["only A"], row["only B"]) == ("57", "57", "3", "0")
    assert not found.is_none


def test_another_size_is_said(tmp_path):
    def enlarge(messages):
        put(messages, IMAGE, 5, image(stamp(5), np.zeros((9, 9))))

    found, rows = changed(tmp_path, enlarge)
    assert "cannot be compared: an image of (8, 6) pixels against one of (9, 9)" in table(found)
    assert rows[IMAGE, "grey levels, mean"]["worst"] == "0"
    assert not found.is_none


def test_a_topic_of_one_alone_is_said(tmp_path):
    def drop(messages):
        messages[:] = [each for each in messages if each[0] != WRENCH]

    one, other = press(10), press(10)
    drop(other)
    write(tmp_path / "a.mcap", one)
    with_types = write(tmp_path / "b.mcap", other)
    found = diff(read_bag(tmp_path / "a.mcap"), read_bag(with_types))
    assert not found.is_none
    assert any(WRENCH in note for note in found.notes)
    assert found.left_out == []


def test_what_cannot_be_compared_is_refused(tmp_path, capsys, shared_data):
    messages = press(60)
    one = write(tmp_path / "a.mcap", messages)
    later = [[topic, b"\0\1\0\0\1" + data[5:], *rest] for topic, data, *rest in messages]
    content = bytearray(one.read_bytes())
    content[content.index(messages[130][1]) + 20] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(content)
    for other, word in (
        (write(tmp_path / "later.mcap", later), "no stamp in common"),
        (shared_data / "ros2-jazzy/bags/probe_path_mcap", "no poses, nodes, wrenches or images"),
        (tmp_path / "none.mcap", "there is no bag"),
        (tmp_path / "damaged.mcap", "is damaged"),
    ):
        assert main(["bag", "diff", str(one), str(other)]) == 2
        assert word in capsys.readouterr().err
