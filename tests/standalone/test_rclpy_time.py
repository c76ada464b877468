"""Durations, times, clocks, and simulated time from /clock."""

import pytest
from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.duration import Duration, Infinite
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMsg

FEW = settings(max_examples=30, deadline=None)
NANOSECONDS = st.integers(0, 2**62)


@FEW
@given(NANOSECONDS, st.integers(-(2**61), 2**61))
def test_adding_a_duration_and_subtracting_a_time_are_inverse(start: int, span: int) -> None:
    time = Time(nanoseconds=start, clock_type=ClockType.ROS_TIME)
    duration = Duration(nanoseconds=span)
    if start + span < 0:
        with pytest.raises(ValueError, match="negative"):
            time + duration
    else:
        assert time + duration - time == duration
        assert time + duration - duration == time


@FEW
@given(st.integers(0, (2**31 - 1) * 10**9))
def test_messages_keep_every_nanosecond(nanoseconds: int) -> None:
    time = Time(nanoseconds=nanoseconds, clock_type=ClockType.ROS_TIME)
    assert Time.from_msg(time.to_msg()) == time
    duration = Duration(nanoseconds=nanoseconds)
    assert Duration.from_msg(duration.to_msg()) == duration
    assert Duration.from_msg(Duration(nanoseconds=-1).to_msg()).nanoseconds == -1


def test_seconds_and_nanoseconds_add_up() -> None:
    assert Duration(seconds=1.5, nanoseconds=7).nanoseconds == 1_500_000_007
    assert Time(seconds=2, nanoseconds=5).seconds_nanoseconds() == (2, 5)
    assert Time(seconds=1).to_msg() == TimeMsg(sec=1)
    assert Duration(seconds=-0.5).to_msg() == DurationMsg(sec=-1, nanosec=500_000_000)
    assert str(Infinite) == "Infinite"
    assert repr(Time(seconds=1)) == "Time(nanoseconds=1000000000, clock_type=SYSTEM_TIME)"


def test_times_of_different_clocks_have_nothing_in_common() -> None:
    ros, system = Time(clock_type=ClockType.ROS_TIME), Time()
    with pytest.raises(TypeError, match="different clock types"):
        ros - system
    with pytest.raises(TypeError, match="different clock types"):
        assert ros < system
    with pytest.raises(TypeError, match="different clock types"):
        assert ros == system


def test_impossible_times_are_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        Time(seconds=-1)
    with pytest.raises(ValueError, match="must not be negative"):
        Time(nanoseconds=-1)
    with pytest.raises(OverflowError):
        Time(nanoseconds=2**63)
    with pytest.raises(OverflowError):
        Duration(nanoseconds=2**63)
    with pytest.raises(OverflowError, match="Addition leads to overflow"):
        Time(nanoseconds=2**63 - 1) + Duration(nanoseconds=1)
    with pytest.raises(TypeError, match="ClockType"):
        Time(clock_type="ROS_TIME")
    with pytest.raises(TypeError, match=r"builtin_interfaces\.msg\.Time"):
        Time.from_msg(DurationMsg())
    with pytest.raises(TypeError, match=r"builtin_interfaces\.msg\.Duration"):
        Duration.from_msg(TimeMsg())


def test_clocks_have_a_kind() -> None:
    assert Clock().clock_type is ClockType.SYSTEM_TIME
    assert isinstance(Clock(clock_type=ClockType.ROS_TIME), ROSClock)
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    assert steady.now() <= steady.now()
    with pytest.raises(TypeError, match="ClockType"):
        Clock(clock_type=1.0)


def test_a_clock_shows_the_time_it_is_set_to_once_it_is_active() -> None:
    clock = ROSClock()
    ten = Time(seconds=10, clock_type=ClockType.ROS_TIME)
    clock.set_ros_time_override(ten)
    assert not clock.ros_time_is_active
    assert clock.now() > ten
    clock._set_ros_time_is_active(True)
    assert clock.now() == ten
    with pytest.raises(TypeError, match=r"rclpy\.time\.Time"):
        clock.set_ros_time_override(10)


def test_a_node_with_use_sim_time_lives_by_the_clock_topic(bench) -> None:
    node = bench.node(parameter_overrides=[Parameter("use_sim_time", value=True)])
    publisher = bench.node("simulator").create_publisher(ClockMsg, "/clock", 10)
    calls: list[int] = []
    node.create_timer(1.0, lambda: calls.append(node.get_clock().now().nanoseconds))
    assert node.get_clock().ros_time_is_active
    assert node.get_clock().now().nanoseconds == 0
    assert bench.spin_until(lambda: publisher.get_subscription_count() == 1)

    def show(seconds: float) -> None:
        message = ClockMsg(clock=Time(seconds=seconds).to_msg())
        publisher.publish(message)
        assert bench.spin_until(lambda: node.get_clock().now().to_msg() == message.clock)
        bench.executor.spin_once(timeout_sec=0.02)

    show(0.5)
    assert calls == []
    show(1.25)
    show(1.5)
    assert calls == [1_250_000_000]
    show(2.0)
    assert calls == [1_250_000_000, 2_000_000_000]
    show(10.0)  # eight periods at once are one call
    assert len(calls) == 3
    show(0.25)  # back: the next call is one period after that
    show(1.0)
    assert len(calls) == 3
    show(1.25)
    assert len(calls) == 4


def test_use_sim_time_can_be_switched_and_must_be_a_bool(bench) -> None:
    node = bench.node()
    assert not node.get_clock().ros_time_is_active
    assert node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
    assert node.get_clock().ros_time_is_active
    assert bench.spin_until(lambda: node.count_subscribers("/clock") == 1)
    assert node.set_parameters([Parameter("use_sim_time", value=False)])[0].successful
    assert not node.get_clock().ros_time_is_active
    assert node.get_clock().now().nanoseconds > 10**18
    assert not node.set_parameters([Parameter("use_sim_time", value=3)])[0].successful
