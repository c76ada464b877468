"""Recordings of public reports: what `us-sim bag check` says about each."""

import shutil

import pytest

from us_sim.recording.reader import read_bag
from us_sim.run.session_check import check_bag


def found(path):
    return [finding.text for finding in check_bag(read_bag(path)).findings]


def test_a_wrong_time_is_one_finding(shared_file):
    (text,) = found(shared_file("cases/bag-time-back/stamps_back_by_20_s.mcap"))
    assert "went back in their stamps" in text


def test_log_times_that_go_back_are_said_with_their_place(shared_file):
    said = found(shared_file("cases/bag-time-back/log_time_back_too.mcap"))
    assert any("clock was set back" in text for text in said)


@pytest.mark.slow
def test_a_bag_of_every_type_is_read_to_the_end(shared_file):
    checked = check_bag(
        read_bag(shared_file("cases/bag-every-type/test_bag_mcap/metadata.yaml").parent)
    )
    assert len(checked.topics) == 94
    assert all(len(each.messages) == each.topic.message_count == 2 for each in checked.topics)
    assert not any("too short" in finding.text for finding in checked.findings)


def test_all_stamps_zero_is_said_of_each_topic(shared_file):
    """The images, and the poses of a PoseArray; those of the others rise."""
    said = found(shared_file("cases/bag-stamps-zero/zed_like.mcap"))
    assert len(said) == 2
    assert any(
        "/zed/zed_node/left/image_rect_color has stamps that are all 0" in text for text in said
    )


def test_packed_messages_are_read_unpacked(shared_file):
    bag = read_bag(shared_file("cases/bag-packed-messages/soccer_goal_12.mcap"))
    images = [bag.deserialize(message) for message in bag.read_messages()]
    assert len(images) == 2
    assert {(image.height, image.width) for image in images} == {(480, 640)}


def test_of_thirteen_parts_the_one_that_is_there_is_read(shared_file, tmp_path):
    folder = shared_file("cases/bag-packed-messages/soccer_goal_12.mcap").parent
    shutil.copy(folder / "soccer_goal_12.mcap", tmp_path)
    shutil.copy(folder / "metadata_of_13_parts.yaml", tmp_path / "metadata.yaml")
    bag = read_bag(tmp_path)
    assert len(list(bag.read_messages())) == 2
    assert all(f"soccer_goal_{part}.mcap" in bag.fault for part in range(12))


def test_parts_whose_names_begin_with_their_number_are_one_recording(shared_file):
    folder = shared_file("cases/bag-parts-of-lyrical/0_session_2026_06_24-10_00_00.mcap").parent
    times = [message.log_time for message in read_bag(folder).read_messages()]
    assert len(times) == 600
    assert times == sorted(times)
