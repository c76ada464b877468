"""Quality of service in a bag's YAML, against real bags and rclpy's introspected profiles."""

from enum import IntEnum
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import BagError
from us_sim.recording.topic import INFINITE, QosProfile, qos_from_yaml, qos_to_yaml

profiles = st.builds(
    QosProfile,
    history=st.sampled_from(["keep_last", "keep_all", "unknown", "system_default"]),
    depth=st.integers(0, 2**31),
    reliability=st.sampled_from(["reliable", "best_effort", "best_available"]),
    durability=st.sampled_from(["volatile", "transient_local"]),
    deadline=st.integers(0, INFINITE),
    lifespan=st.integers(0, INFINITE),
    liveliness=st.sampled_from(["automatic", "manual_by_topic"]),
    liveliness_lease_duration=st.integers(0, INFINITE),
    avoid_ros_namespace_conventions=st.booleans(),
)


def test_the_default_is_what_a_real_publisher_of_depth_10_was_recorded_with(shared_data):
    metadata = yaml.safe_load(
        (shared_data / "ros2-jazzy/bags/probe_path_mcap/metadata.yaml").read_text()
    )
    topics = metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    pose = next(
        t["topic_metadata"] for t in topics if t["topic_metadata"]["name"] == "/tracker/pose"
    )
    assert qos_from_yaml(pose["offered_qos_profiles"]) == (QosProfile(),)


@settings(max_examples=50, deadline=None)
@given(st.lists(profiles, max_size=3))
def test_yaml_round_trip(profiles):
    assert qos_from_yaml(qos_to_yaml(profiles)) == tuple(profiles)


def test_numbers_of_older_bags_are_the_policies_of_rmw():
    assert qos_from_yaml(
        "- history: 3\n  depth: 0\n  reliability: 2\n  durability: 1\n"
        "  deadline:\n    sec: 2147483647\n    nsec: 4294967295\n"
        "  lifespan:\n    sec: 10\n    nsec: 5\n  liveliness: 1\n"
        "  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n"
        "  avoid_ros_namespace_conventions: false"
    ) == (
        QosProfile(
            history="unknown",
            depth=0,
            reliability="best_effort",
            durability="transient_local",
            deadline=2147483647 * 10**9 + 4294967295,
            lifespan=10 * 10**9 + 5,
            liveliness_lease_duration=0,
        ),
    )


def test_an_object_with_the_attributes_of_rclpy_is_taken():
    class Policy(IntEnum):
        KEEP_LAST = 1
        BEST_EFFORT = 2
        TRANSIENT_LOCAL = 3
        AUTOMATIC = 4

    infinite = SimpleNamespace(nanoseconds=INFINITE)
    profile = SimpleNamespace(
        history=Policy.KEEP_LAST,
        depth=1,
        reliability=Policy.BEST_EFFORT,
        durability=Policy.TRANSIENT_LOCAL,
        deadline=infinite,
        lifespan=infinite,
        liveliness=Policy.AUTOMATIC,
        liveliness_lease_duration=infinite,
        avoid_ros_namespace_conventions=False,
    )
    assert QosProfile.of(profile) == QosProfile(
        depth=1, reliability="best_effort", durability="transient_local"
    )


@pytest.mark.parametrize("empty", ["", None, [], "[]"])
def test_no_profiles(empty):
    assert qos_from_yaml(empty) == ()


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("- history: [", "offered_qos_profiles: the QoS profiles are not YAML"),
        ("history: 1", "offered_qos_profiles: this is not a list"),
        ("- history: keep_last", "lacks 'depth'"),
        ("- 5", "no QoS profile"),
        (
            qos_to_yaml([QosProfile()]).replace("reliable", "rather"),
            "reliability cannot be 'rather'",
        ),
        (qos_to_yaml([QosProfile()]).replace("keep_last", "9"), "history cannot be 9"),
        (qos_to_yaml([QosProfile()]).replace("depth: 10", "depth: -1"), "depth cannot be negative"),
        (qos_to_yaml([QosProfile()]).replace("nsec:", "ns:"), "not a duration"),
    ],
)
def test_refusals(document, message):
    with pytest.raises(BagError, match=message):
        qos_from_yaml(document)
