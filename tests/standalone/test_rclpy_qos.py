"""Quality of service: which profiles meet, and what a profile refuses."""

import pytest
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    LivelinessPolicy,
    QoSCompatibility,
    QoSPresetProfiles,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_profile_sensor_data,
    qos_profile_system_default,
)


def profile(**policies: object) -> QoSProfile:
    return QoSProfile(
        depth=1,
        **{"liveliness": LivelinessPolicy.AUTOMATIC, **policies},  # type: ignore[arg-type]
    )


SECOND, MINUTE = Duration(seconds=1), Duration(seconds=60)


@pytest.mark.parametrize(
    ("offered", "asked", "reason"),
    [
        ({}, {}, ""),
        ({}, {"reliability": ReliabilityPolicy.BEST_EFFORT}, ""),
        ({"durability": DurabilityPolicy.TRANSIENT_LOCAL}, {}, ""),
        ({"deadline": SECOND}, {"deadline": MINUTE}, ""),
        ({"liveliness": LivelinessPolicy.MANUAL_BY_TOPIC}, {}, ""),
        (
            {"reliability": ReliabilityPolicy.BEST_EFFORT},
            {},
            "ERROR: Best effort publisher and reliable subscription;",
        ),
        (
            {},
            {"durability": DurabilityPolicy.TRANSIENT_LOCAL},
            "ERROR: Volatile publisher and transient local subscription;",
        ),
        (
            {},
            {"deadline": SECOND},
            "ERROR: Subscription has a deadline, but publisher does not;",
        ),
        (
            {"deadline": MINUTE},
            {"deadline": SECOND},
            "ERROR: Subscription deadline is less than publisher deadline;",
        ),
        (
            {},
            {"liveliness": LivelinessPolicy.MANUAL_BY_TOPIC},
            "ERROR: Publisher's liveliness is automatic and subscription's is manual by topic;",
        ),
        (
            {},
            {"liveliness_lease_duration": SECOND},
            "ERROR: Subscription has a liveliness lease duration, but publisher does not;",
        ),
        (
            {"liveliness_lease_duration": MINUTE},
            {"liveliness_lease_duration": SECOND},
            "ERROR: Subscription liveliness lease duration is less than publisher;",
        ),
        (
            {"reliability": ReliabilityPolicy.SYSTEM_DEFAULT},
            {},
            "WARNING: Reliable subscription, but publisher is system_default;",
        ),
        (
            {"durability": DurabilityPolicy.SYSTEM_DEFAULT},
            {"durability": DurabilityPolicy.TRANSIENT_LOCAL},
            "WARNING: Transient local subscription, but publisher is system_default;",
        ),
        (
            {},
            {"liveliness": LivelinessPolicy.SYSTEM_DEFAULT},
            "WARNING: Publisher's liveliness is automatic, but subscription's is system_default;",
        ),
    ],
)
def test_a_subscription_meets_what_offers_at_least_as_much(
    offered: dict, asked: dict, reason: str
) -> None:
    compatibility, text = qos_check_compatible(profile(**offered), profile(**asked))
    assert text == reason
    assert compatibility == QoSCompatibility(
        {"E": QoSCompatibility.ERROR, "W": QoSCompatibility.WARNING}.get(
            reason[:1], QoSCompatibility.OK
        )
    )


def test_several_contradictions_are_all_told() -> None:
    best_effort = profile(reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = profile(durability=DurabilityPolicy.TRANSIENT_LOCAL)
    _, reason = qos_check_compatible(best_effort, latched)
    assert reason == (
        "ERROR: Best effort publisher and reliable subscription;"
        "ERROR: Volatile publisher and transient local subscription;"
    )


def test_defaults_left_to_the_middleware_make_three_doubts() -> None:
    unsure = qos_profile_system_default
    compatibility, reason = qos_check_compatible(unsure, unsure)
    assert compatibility == QoSCompatibility.WARNING
    assert reason.count("WARNING: ") == 3


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


def test_short_names_are_those_of_parameters_and_tools() -> None:
    assert ReliabilityPolicy.short_keys() == [
        "system_default",
        "reliable",
        "best_effort",
        "unknown",
        "best_available",
    ]
    assert HistoryPolicy.get_from_short_key("Keep_All") == 2
    assert DurabilityPolicy.TRANSIENT_LOCAL.short_key == "transient_local"
    assert QoSPresetProfiles.get_from_short_key("sensor_data") is qos_profile_sensor_data
