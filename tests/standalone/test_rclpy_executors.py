"""Executors: what runs when, in which order, in which thread, and what ends them."""

import threading
import time
from contextlib import suppress
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

STEADY = Clock(clock_type=ClockType.STEADY_TIME)


def test_what_is_ready_at_once_runs_in_rclpys_order(bench) -> None:
    order: list[str] = []
    node = bench.node()
    node.create_service(Trigger, "service", lambda _, r: (order.append("service"), r)[1])
    client = node.create_client(Trigger, "service")
    node.create_subscription(Int32, "topic", lambda _: order.append("subscription"), 10)
    publisher = node.create_publisher(Int32, "topic", 10)
    assert client.wait_for_service(timeout_sec=5.0)
    assert bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    guard = node.create_guard_condition(lambda: order.append("guard"))
    timer = node.create_timer(0.001, lambda: (order.append("timer"), timer.cancel()))
    for _ in range(2):
        publisher.publish(Int32())
    client.call_async(Trigger.Request())
    guard.trigger()
    time.sleep(0.3)
    assert bench.spin_until(lambda: "service" in order)
    first = order[: order.index("service") + 1]
    assert first == ["timer", "subscription", "guard", "service"]
    assert bench.spin_until(lambda: order.count("subscription") == 2)


def test_spin_once_runs_one_callback_and_gives_up_after_its_time(bench) -> None:
    calls: list[int] = []
    node = bench.node()
    guards = [node.create_guard_condition(lambda i=i: calls.append(i)) for i in range(3)]
    for guard in guards:
        guard.trigger()
        guard.trigger()
    for count in range(1, 4):
        bench.executor.spin_once(timeout_sec=5)
        assert len(calls) == count
    start = time.monotonic()
    bench.executor.spin_once(timeout_sec=0.05)
    assert 0.04 < time.monotonic() - start < 1
    assert calls == [0, 1, 2]
    bench.executor.spin_once(timeout_sec=0)
    assert calls == [0, 1, 2]


def test_timers_skip_the_periods_they_missed(bench) -> None:
    calls: list[float] = []
    node = bench.node()
    timer = node.create_timer(0.02, lambda: calls.append(time.monotonic()), clock=STEADY)
    time.sleep(0.11)
    assert timer.is_ready()
    assert timer.time_until_next_call() < 0
    bench.executor.spin_once(timeout_sec=1)
    assert len(calls) == 1
    assert not timer.is_ready()
    assert 0 < timer.time_until_next_call() <= 20_000_000
    bench.executor.spin_once(timeout_sec=0)
    assert len(calls) == 1


def test_timers_keep_their_pace(bench) -> None:
    calls: list[int] = []
    node = bench.node()
    start = STEADY.now().nanoseconds
    node.create_timer(0.02, lambda: calls.append(STEADY.now().nanoseconds), clock=STEADY)
    assert bench.spin_until(lambda: len(calls) == 21)
    delays = sorted((call - start) % 20_000_000 for call in calls)
    assert delays[10] < 6_000_000  # ns after a whole number of periods, however late single ones


def test_timers_stop_start_and_change(bench) -> None:
    calls: list[int] = []
    node = bench.node()
    timer = node.create_timer(0.01, lambda: calls.append(1), clock=STEADY, autostart=False)
    assert timer.is_canceled()
    assert timer.time_until_next_call() is None
    bench.executor.spin_once(timeout_sec=0.03)
    assert not calls
    timer.reset()
    assert bench.spin_until(lambda: calls)
    timer.cancel()
    assert not timer.is_ready()
    timer.timer_period_ns = 5_000_000
    assert timer.timer_period_ns == 5_000_000
    timer.reset()
    assert timer.time_until_next_call() <= 5_000_000
    assert timer.time_since_last_call() >= 0
    assert node.destroy_timer(timer)
    with pytest.raises(InvalidHandle):
        timer.reset()
    with pytest.raises(RuntimeError, match="failed to create timer"):
        node.create_timer(-1.0, print)


def test_waiting_takes_no_time_of_the_processor(bench) -> None:
    node = bench.node()
    node.create_subscription(Int32, "topic", print, 10)
    bench.executor.spin_once(timeout_sec=0.1)
    start = time.process_time()
    bench.executor.spin_once(timeout_sec=0.5)
    assert time.process_time() - start < 0.1


def test_another_thread_can_wake_an_executor(bench) -> None:
    calls: list[int] = []
    guard = bench.node().create_guard_condition(lambda: calls.append(1))
    timer = threading.Timer(0.05, guard.trigger)
    timer.start()
    start = time.monotonic()
    bench.executor.spin_once(timeout_sec=10)
    assert calls == [1]
    assert time.monotonic() - start < 5
    timer.join()


def test_errors_in_callbacks_reach_whoever_spins(bench) -> None:
    def fail() -> None:
        raise ValueError("bad mesh")

    guard = bench.node().create_guard_condition(fail)
    guard.trigger()
    with pytest.raises(ValueError, match="bad mesh"):
        bench.executor.spin_once(timeout_sec=5)
    guard.trigger()
    with pytest.raises(ValueError, match="bad mesh"):
        bench.executor.spin_once(timeout_sec=5)


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy runs coroutines")
def test_coroutines_are_refused_where_they_are_given(bench) -> None:
    async def later(*_: Any) -> None: ...

    node = bench.node()
    for create in (
        lambda: node.create_timer(1.0, later),
        lambda: node.create_guard_condition(later),
        lambda: node.create_subscription(Int32, "count", later, 1),
        lambda: node.create_service(Trigger, "reset", later),
    ):
        with pytest.raises(TypeError, match="later is a coroutine, which this subset"):
            create()


def test_errors_in_done_callbacks_of_requests_reach_whoever_spins(bench) -> None:
    node = bench.node()
    node.create_service(Trigger, "reset", lambda _, response: response)
    client = node.create_client(Trigger, "reset")
    assert client.wait_for_service(timeout_sec=5.0)

    def fail(_: Future) -> None:
        raise ValueError("bad mesh")

    client.call_async(Trigger.Request()).add_done_callback(fail)
    with pytest.raises(ValueError, match="bad mesh"):
        bench.spin_until(lambda: False, seconds=5)
    lonely: Future = Future()
    lonely.add_done_callback(fail)
    with pytest.warns(UserWarning, match="Unhandled exception in done callback: bad mesh"):
        lonely.set_result(1)


def test_futures_tell_when_they_are_done(capsys) -> None:
    future: Future = Future()
    seen: list[Any] = []
    future.add_done_callback(lambda f: seen.append(f.result()))
    assert not future.done()
    assert future.result() is None
    future.set_result(3)
    assert future.done()
    assert seen == [3]
    future.add_done_callback(lambda f: seen.append(f.result() + 1))
    assert seen == [3, 4]
    failed: Future = Future()
    failed.set_exception(ValueError("bad mesh"))
    with pytest.raises(ValueError, match="bad mesh"):
        failed.result()
    cancelled: Future = Future()
    cancelled.cancel()
    assert cancelled.cancelled()
    assert not cancelled.done()
    lost: Future = Future()
    lost.set_exception(ValueError("nobody asked"))
    del lost
    assert "never retrieved: nobody asked" in capsys.readouterr().err


def test_spinning_until_a_future_is_done_ends_then_or_in_time(bench) -> None:
    node = bench.node()
    future: Future = Future()
    start = time.monotonic()
    bench.executor.spin_until_future_complete(future, timeout_sec=0.05)
    assert 0.04 < time.monotonic() - start < 2
    guard = node.create_guard_condition(lambda: future.set_result(1))
    guard.trigger()
    rclpy.spin_until_future_complete(node, future, bench.executor, timeout_sec=5)
    assert future.result() == 1
    threaded: Future = Future()
    timer = threading.Timer(0.05, lambda: threaded.set_result(2))
    timer.start()
    bench.executor.spin_until_future_complete(threaded)
    assert threaded.result() == 2
    timer.join()


def test_spinning_again_and_again_leaves_nothing_at_a_future(bench) -> None:
    future = Future()
    for _ in range(3):
        bench.executor.spin_until_future_complete(future, timeout_sec=0.0)
        bench.executor.spin_once_until_future_complete(future, timeout_sec=0.0)
    assert future._callbacks == []


def test_nodes_belong_to_one_executor(bench) -> None:
    node = bench.node()
    assert node.executor is bench.executor
    assert not bench.executor.add_node(node)
    with SingleThreadedExecutor(context=bench.context) as other:
        assert other.add_node(node)
        assert node.executor is other
        assert bench.executor.get_nodes() == []
        assert other.get_nodes() == [node]
        other.remove_node(node)
        assert other.get_nodes() == []


def test_shutting_down_the_executor_ends_spinning(bench) -> None:
    bench.node()
    timer = threading.Timer(0.05, bench.executor.shutdown)
    timer.start()
    bench.executor.spin()
    timer.join()
    assert bench.context.ok()


def overlap(executor: MultiThreadedExecutor, node: Node, group: Any) -> int:
    """How many of two callbacks of a group ran at the same time at most."""
    running: list[int] = []
    most: list[int] = []
    done: list[int] = []
    both = threading.Barrier(2)

    def work() -> None:
        running.append(1)
        most.append(len(running))
        with suppress(threading.BrokenBarrierError):
            both.wait(timeout=0.2)
        running.pop()
        done.append(1)

    guards = [node.create_guard_condition(work, callback_group=group) for _ in range(2)]
    for guard in guards:
        guard.trigger()
    end = time.monotonic() + 5
    while len(done) < 2 and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)
    assert len(done) == 2
    return max(most)


def test_groups_decide_what_runs_at_the_same_time(bench) -> None:
    bench.executor.shutdown()
    node = Node("probe", context=bench.context)
    executor = MultiThreadedExecutor(2, context=bench.context)
    executor.add_node(node)
    try:
        assert overlap(executor, node, ReentrantCallbackGroup()) == 2
        assert overlap(executor, node, MutuallyExclusiveCallbackGroup()) == 1
    finally:
        executor.shutdown()
        node.destroy_node()


def test_many_threads_lose_no_message_and_raise_errors(bench) -> None:
    node = Node("probe", context=bench.context)
    received: list[int] = []
    node.create_subscription(
        Int32,
        "count",
        lambda m: received.append(m.data),
        200,
        callback_group=ReentrantCallbackGroup(),
    )
    publisher = node.create_publisher(Int32, "count", 200)

    def fail() -> None:
        raise ValueError("bad mesh")

    guard = node.create_guard_condition(fail)
    with MultiThreadedExecutor(4, context=bench.context) as executor:
        executor.add_node(node)
        end = time.monotonic() + 10
        while publisher.get_subscription_count() == 0:
            executor.spin_once(timeout_sec=0.05)
        for index in range(200):
            publisher.publish(Int32(data=index))
        while len(received) < 200 and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        assert sorted(received) == list(range(200))
        guard.trigger()

        other = node.create_guard_condition(lambda: None)

        def spin() -> None:
            for _ in range(20):
                other.trigger()  # rclpy looks for errors when it has other work
                executor.spin_once(timeout_sec=0.05)

        with pytest.raises(ValueError, match="bad mesh"):
            spin()
    node.destroy_node()
    with pytest.warns(UserWarning, match="single thread"):
        MultiThreadedExecutor(1, context=bench.context).shutdown()


def test_groups_know_their_entities(bench) -> None:
    group = MutuallyExclusiveCallbackGroup()
    guard = bench.node().create_guard_condition(print, callback_group=group)
    other = bench.node("other").create_guard_condition(print)
    assert group.has_entity(guard)
    assert not group.has_entity(other)
    assert group.can_execute(guard)
    assert group.beginning_execution(guard)
    assert not group.can_execute(guard)
    assert not group.beginning_execution(guard)
    group.ending_execution(guard)
    assert group.can_execute(guard)
    with pytest.raises(AssertionError):
        group.beginning_execution(other)
