"""Wrenches in bags: round trips, and what is none."""

import numpy as np
import pytest

from us_sim.errors import BagError
from us_sim.recording.path import write_path
from us_sim.recording.press_and_slide import press_and_slide
from us_sim.recording.wrench import WrenchRecord, read_wrenches, write_wrenches
from us_sim.recording.writer import BagWriter


def record(frame="probe", topic="/probe/wrench"):
    random = np.random.default_rng(0)
    stamps = 10**18 + np.arange(20) * 16_666_667
    return WrenchRecord(topic, frame, stamps, random.normal(size=(20, 6)))


def test_what_is_written_is_read(tmp_path):
    made = record()
    write_wrenches(tmp_path / "press.mcap", made)
    read = read_wrenches(tmp_path / "press.mcap")
    assert (read.topic, read.frame_id, len(read)) == ("/probe/wrench", "probe", 20)
    assert np.array_equal(read.stamps, made.stamps)
    assert np.array_equal(read.wrenches, made.wrenches)


def test_several_sensors_in_one_bag_are_read_by_their_topics(tmp_path):
    with BagWriter(tmp_path / "two.mcap") as writer:
        write_wrenches(writer, record())
        write_wrenches(writer, record("flange", "/arm/wrench"))
    assert read_wrenches(tmp_path / "two.mcap", "arm/wrench").frame_id == "flange"


def test_wrenches_of_two_frames_on_one_topic_are_refused(tmp_path):
    with BagWriter(tmp_path / "two.mcap") as writer:
        write_wrenches(writer, record())
        write_wrenches(writer, record("flange"))
    with pytest.raises(BagError, match="in the frames probe, flange"):
        read_wrenches(tmp_path / "two.mcap")


def test_another_type_a_silent_topic_and_a_missing_one_are_refused(tmp_path):
    path = press_and_slide(rate=5.0)
    write_path(tmp_path / "path.mcap", path)
    with pytest.raises(BagError, match="as geometry_msgs/msg/PoseStamped, not"):
        read_wrenches(tmp_path / "path.mcap", path.topic)
    with pytest.raises(BagError, match="has no topic probe/wrench"):
        read_wrenches(tmp_path / "path.mcap")
    none = WrenchRecord("/probe/wrench", "probe", np.zeros(0, np.int64), np.zeros((0, 6)))
    (tmp_path / "silent").mkdir()
    write_wrenches(tmp_path / "silent" / "silent.mcap", none)
    with pytest.raises(BagError, match="holds no wrench"):
        read_wrenches(tmp_path / "silent" / "silent.mcap")


def test_arrays_that_do_not_go_together_are_refused():
    with pytest.raises(BagError, match="as many wrenches"):
        WrenchRecord("/w", "probe", np.zeros(3, np.int64), np.zeros((2, 6)))
