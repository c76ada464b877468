"""metadata.yaml and quality of service in it, against real bags of every version and rclpy."""

import pytest
import yaml
from rosbags.interfaces import QosDurability, QosHistory, QosReliability, QosTime

from us_sim.errors import BagError
from us_sim.recording.metadata import read_metadata
from us_sim.recording.topic import DEFAULT_QOS, qos_from_yaml, qos_to_yaml


def test_real_metadata_is_written_again(shared_data):
    file = shared_data / "ros2-jazzy/bags/probe_path_mcap/metadata.yaml"
    again = yaml.safe_load(read_metadata(file).document())
    assert again == yaml.safe_load(file.read_text())


def test_every_older_version_is_read(shared_data):
    files = sorted((shared_data / "mcap-rosbag2").rglob("metadata.yaml"))
    assert len(files) >= 10
    for file in files:
        information = yaml.safe_load(file.read_text())["rosbag2_bagfile_information"]
        read = read_metadata(file)
        assert [*read.files] == information["relative_file_paths"]
        assert [(topic.name, topic.message_count) for topic in read.topics] == [
            (topic["topic_metadata"]["name"], topic["message_count"])
            for topic in information["topics_with_message_count"]
        ]


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


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (None, "No such file"),
        ("", "not the metadata of a bag"),
        ("scene: upper_arm", "lacks 'rosbag2_bagfile_information'"),
        ("rosbag2_bagfile_information: {version: 10}", "version 10, newer than the 9"),
    ],
)
def test_refused_metadata(tmp_path, text, word):
    file = tmp_path / "metadata.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(BagError, match=f"{file}.*{word}"):
        read_metadata(file)


DEFAULT = qos_to_yaml([DEFAULT_QOS])


def test_the_default_is_what_a_real_publisher_of_depth_10_was_recorded_with(shared_data):
    real = read_metadata(shared_data / "ros2-jazzy/bags/probe_path_mcap/metadata.yaml")
    (pose,) = (topic for topic in real.topics if topic.name == "/tracker/pose")
    assert pose.qos == (DEFAULT_QOS,)
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
