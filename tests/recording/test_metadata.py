"""metadata.yaml, against the real ones of every version at hand."""

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import BagError
from us_sim.recording.metadata import BagMetadata, FileEntry, TopicEntry, read_metadata
from us_sim.recording.topic import QosProfile


@pytest.mark.parametrize("bag", ["chunkzstd", "mcap", "sqlite3", "zstd"])
def test_real_metadata_is_written_again_to_the_letter(shared_data, bag):
    file = shared_data / f"ros2-jazzy/bags/probe_path_{bag}/metadata.yaml"
    real = read_metadata(file)
    information = yaml.safe_load(file.read_text())["rosbag2_bagfile_information"]
    (entry,) = information["files"]
    whole = FileEntry(entry["path"], real.start, real.duration, real.message_count)
    again = BagMetadata(**{**vars(real), "files": (whole,)}).document()
    # A bag compressed as a whole lists the packed file first and the unpacked one below.
    expected = file.read_text().replace(
        "  - probe_path_zstd_0.mcap.zstd", "  - probe_path_zstd_0.mcap"
    )
    assert again == expected


def test_every_older_version_is_read(shared_data):
    files = sorted((shared_data / "mcap-rosbag2").rglob("metadata.yaml"))
    assert len(files) >= 10
    for file in files:
        information = yaml.safe_load(file.read_text())["rosbag2_bagfile_information"]
        read = read_metadata(file)
        assert [entry.path for entry in read.files] == information["relative_file_paths"]
        assert [(topic.name, topic.message_count) for topic in read.topics] == [
            (topic["topic_metadata"]["name"], topic["message_count"])
            for topic in information["topics_with_message_count"]
        ]


@settings(max_examples=50, deadline=None)
@given(
    st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1, max_size=12),
    st.dictionaries(st.text("ab: #'\"é{}[]~", min_size=1), st.text("xy: -\\\"'%@0"), max_size=3),
)
def test_any_name_survives_yaml(name, custom_data):
    entry = FileEntry(f"{name}.mcap", 5, 7, 1)
    topic = TopicEntry("/a", "std_msgs/msg/String", (QosProfile(), QosProfile(depth=1)), "", 1)
    document = BagMetadata((entry,), (topic,), 5, 7, 1, custom_data=custom_data).document()
    information = yaml.safe_load(document)["rosbag2_bagfile_information"]
    assert information["relative_file_paths"] == [entry.path]
    assert (information["custom_data"] or {}) == custom_data
    assert (
        len(information["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"])
        == 2
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not the metadata of a bag"),
        ("[1, 2", "not the metadata of a bag"),
        ("scene: upper_arm", "lacks 'rosbag2_bagfile_information'"),
        ("rosbag2_bagfile_information: {version: 10}", "version 10, newer than the 9"),
        ("rosbag2_bagfile_information: {version: 9}", "lacks 'relative_file_paths'"),
        ("rosbag2_bagfile_information: 5", "not the metadata of a bag"),
    ],
)
def test_refusals(tmp_path, text, message):
    file = tmp_path / "metadata.yaml"
    file.write_text(text)
    with pytest.raises(BagError, match=message) as caught:
        read_metadata(file)
    assert str(file) in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(BagError, match="No such file"):
        read_metadata(tmp_path / "metadata.yaml")
