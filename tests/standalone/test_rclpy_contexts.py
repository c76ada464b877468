"""Contexts: what needs one, and what their end ends."""

import threading

import pytest
import rclpy
from rclpy.context import Context
from rclpy.exceptions import NotInitializedException
from rclpy.executors import (
    ExternalShutdownException,
    SingleThreadedExecutor,
)
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node


def test_the_end_of_a_context_is_told_once(bench) -> None:
    told: list[str] = []

    class Listener:
        def listen(self) -> None:
            told.append("method")

    listener, forgotten = Listener(), Listener()
    bench.context.on_shutdown(listener.listen)
    bench.context.on_shutdown(forgotten.listen)
    del forgotten
    with pytest.raises(TypeError):
        bench.context.on_shutdown("not callable")
    bench.context.shutdown()
    assert told == ["method"]
    bench.context.on_shutdown(lambda: told.append("late"))
    bench.context.try_shutdown()
    assert told == ["method", "late"]


def test_nothing_works_before_init() -> None:
    context = Context()
    with pytest.raises(NotInitializedException, match=r"rclpy\.init\(\) has not been called"):
        Node("probe", context=context)
    with pytest.raises((NotInitializedException, AttributeError, TypeError)):
        SingleThreadedExecutor(context=context)
    with pytest.raises((NotInitializedException, AttributeError, TypeError)):
        GuardCondition(print, None, context=context)
    with pytest.raises(RuntimeError, match="must be initialized"):
        context.shutdown()
    context.try_shutdown()
    assert not context.ok()
    context.init([])
    with pytest.raises(RuntimeError, match="only be called once"):
        context.init([])
    context.shutdown()
    with pytest.raises(NotInitializedException):
        Node("probe", context=context)


def test_a_default_context_serves_who_names_none() -> None:
    rclpy.init(args=[], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    try:
        assert rclpy.ok()
        node = rclpy.create_node("probe")
        calls: list[int] = []
        guard = node.create_guard_condition(lambda: calls.append(1))
        guard.trigger()
        rclpy.spin_once(node, timeout_sec=5)
        assert calls == [1]
        assert node.context is rclpy.get_default_context()
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert not rclpy.ok()
    rclpy.try_shutdown()
    rclpy.init(args=[], signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    rclpy.shutdown()


def test_shutting_down_the_context_ends_spinning(bench) -> None:
    node = bench.node()
    timer = threading.Timer(0.05, bench.context.shutdown)
    timer.start()
    with pytest.raises(ExternalShutdownException):
        rclpy.spin(node, bench.executor)
    timer.join()
    rclpy.spin(node, bench.executor)  # it is down already: nothing to do
    with pytest.raises(RuntimeError, match="already called"):
        bench.context.shutdown()
