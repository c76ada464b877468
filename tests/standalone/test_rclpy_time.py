"""Durations, times, clocks, their jumps, and simulated time from /clock."""

import threading

import pytest
import rclpy
from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold, ROSClock
from rclpy.context import Context
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


def test_a_clock_that_is_set_tells_of_its_jumps() -> None:
    clock = ROSClock()
    jumps: list[tuple[ClockChange, int]] = []
    times_before: list[int] = []
    threshold = JumpThreshold(
        min_forward=Duration(seconds=1), min_backward=Duration(seconds=-1), on_clock_change=True
    )
    handle = clock.create_jump_callback(
        threshold,
        pre_callback=lambda: times_before.append(clock.now().nanoseconds),
        post_callback=lambda jump: jumps.append((jump.clock_change, jump.delta.nanoseconds)),
    )

    def show(seconds: float) -> None:
        clock.set_ros_time_override(Time(seconds=seconds, clock_type=ClockType.ROS_TIME))

    show(10)
    assert not clock.ros_time_is_active
    clock._set_ros_time_is_active(True)
    assert clock.now() == Time(seconds=10, clock_type=ClockType.ROS_TIME)
    show(10.5)
    show(20)
    show(15)
    with handle:
        pass
    show(100)
    assert jumps[0][0] == ClockChange.ROS_TIME_ACTIVATED
    assert jumps[1:] == [
        (ClockChange.ROS_TIME_NO_CHANGE, 9_500_000_000),
        (ClockChange.ROS_TIME_NO_CHANGE, -5_000_000_000),
    ]
    assert times_before[1:] == [10_500_000_000, 20_000_000_000]


def test_jump_thresholds_and_callbacks_are_checked() -> None:
    with pytest.raises(ValueError, match="positive"):
        JumpThreshold(min_forward=Duration(seconds=-1), min_backward=None)
    with pytest.raises(ValueError, match="negative"):
        JumpThreshold(min_forward=None, min_backward=Duration(seconds=1))
    with pytest.raises(ValueError, match="At least one"):
        JumpThreshold(min_forward=None, min_backward=None, on_clock_change=False)
    any_jump = JumpThreshold(min_forward=None, min_backward=None)
    with pytest.raises(ValueError, match="One of"):
        ROSClock().create_jump_callback(any_jump)
    with pytest.raises(ValueError, match="callable"):
        ROSClock().create_jump_callback(any_jump, pre_callback=1)


def test_sleeping_ends_when_the_time_has_come_or_the_context_is_down(bench) -> None:
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    start = clock.now()
    assert clock.sleep_for(Duration(seconds=0.02), context=bench.context)
    assert (clock.now() - start).nanoseconds >= 20_000_000
    assert clock.sleep_until(start, context=bench.context)
    with pytest.raises(ValueError, match="clock type"):
        clock.sleep_until(Time(), context=bench.context)
    threading.Timer(0.05, bench.context.try_shutdown).start()
    assert not clock.sleep_for(Duration(seconds=100), context=bench.context)
    with pytest.raises(rclpy.exceptions.NotInitializedException):
        clock.sleep_for(Duration(seconds=1), context=Context())


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
