"""Quality of service: what a profile holds, and what it refuses."""

import pytest
from rclpy.qos import (
    HistoryPolicy,
    InvalidQoSProfileException,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)


def test_a_profile_needs_history_or_depth() -> None:
    with pytest.raises(InvalidQoSProfileException, match="required"):
        QoSProfile()
    with pytest.raises(InvalidQoSProfileException, match="without a depth"):
        QoSProfile(history=HistoryPolicy.KEEP_LAST)
    assert QoSProfile(history=HistoryPolicy.KEEP_ALL).depth == 10
    assert QoSProfile(depth=3).history is HistoryPolicy.KEEP_LAST


def test_a_profile_refuses_what_is_no_policy() -> None:
    with pytest.raises(AssertionError):
        QoSProfile(depth=1, colour="red")
    with pytest.raises(AssertionError):
        QoSProfile(depth=1, deadline=1.0)
    with pytest.raises(AssertionError):
        QoSProfile(depth=1.0)
    with pytest.raises(ValueError, match="7 is not a valid"):
        QoSProfile(depth=1, reliability=7)
    with pytest.warns(UserWarning, match="zero depth"):
        QoSProfile(depth=0)


def test_profiles_are_equal_by_value_and_show_their_policies() -> None:
    assert QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT) == qos_profile_sensor_data
    assert QoSProfile(depth=5) != qos_profile_sensor_data
    assert str(QoSProfile(depth=5)).startswith("QoSProfile(history=")
    assert "deadline=0 nanoseconds" in str(QoSProfile(depth=5))
