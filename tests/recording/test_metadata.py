"""metadata.yaml and quality of service in it, against real bags of every version and rclpy."""

from pathlib import Path

import pytest
import yaml
from rosbags.interfaces import QosDurability, QosHistory, QosReliability, QosTime

from us_sim.errors import BagError
from us_sim.recording.metadata import bag_information, missing_files
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS, qos_from_yaml, qos_to_yaml


def information_of(folder):
    return yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def test_real_metadata_is_written_again(shared_data):
    folder = shared_data / "ros2-jazzy/bags/probe_path_mcap"
    real, bag = information_of(folder), read_bag(folder)
    order = [each["topic_metadata"]["name"] for each in real["topics_with_message_count"]]
    topics = [bag.find_topic(name) for name in order]
    (file,) = real["relative_file_paths"]
    assert bag_information(file, topics, bag.start, bag.end - bag.start) == real


def test_files_that_are_listed_and_not_there_are_named(shared_data, tmp_path):
    files = sorted((shared_data / "mcap-rosbag2").rglob("metadata.yaml"))
    assert len(files) >= 10
    for file in files:
        (tmp_path / "metadata.yaml").write_text(file.read_text())
        listed = information_of(tmp_path)["relative_file_paths"]
        assert missing_files(tmp_path) == [Path(each).name for each in listed]


@pytest.mark.parametrize("text", ["", "scene: upper_arm", "- [", "rosbag2_bagfile_information: 1"])
def test_other_files_of_that_name_list_nothing(tmp_path, text):
    (tmp_path / "metadata.yaml").write_text(text)
    assert missing_files(tmp_path) == []


def test_numbers_of_older_bags_are_the_policies_of_rmw():
    assert qos_from_yaml(
        "- history: 3\n  depth: 0\n  reliability: 2\n  durability: 1\n"
        "  deadline:\n    sec: 2147483647\n    nsec: 4294967295\n"
        "  lifespan:\n    sec: 10\n    nsec: 5\n  liveliness: 1\n"
        "  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n"
        "  avoid_ros_namespace_conventions: false"
    ) == (
        DEFAULT_QOS._replace(
            history=QosHistory.UNKNOWN,
            depth=0,
            reliability=QosReliability.BEST_EFFORT,
            durability=QosDurability.TRANSIENT_LOCAL,
            deadline=QosTime(2147483647, 4294967295),
            lifespan=QosTime(10, 5),
            liveliness_lease_duration=QosTime(0, 0),
        ),
    )


DEFAULT = qos_to_yaml([DEFAULT_QOS])


def test_the_default_is_what_a_real_publisher_of_depth_10_was_recorded_with(shared_data):
    real = read_bag(shared_data / "ros2-jazzy/bags/probe_path_mcap")
    assert real.find_topic("/tracker/pose").qos == (DEFAULT_QOS,)
    assert qos_from_yaml("") == qos_from_yaml("[]") == qos_from_yaml(None) == ()


@pytest.mark.parametrize(
    "document",
    ["- history: [", "- 5", DEFAULT.replace("nsec:", "ns:")],
)
def test_refused_profiles(document):
    with pytest.raises(BagError, match="QoS"):
        qos_from_yaml(document)


def test_a_policy_of_a_later_version_is_unknown():
    (read,) = qos_from_yaml(DEFAULT.replace("reliable", "rather"))
    assert read.reliability == QosReliability.UNKNOWN
