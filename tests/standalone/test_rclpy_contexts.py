"""Contexts, their ends, and the graph that the nodes of several of them show."""

import threading

import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration, Infinite
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointTypeEnum
from sensor_msgs.msg import Image
from std_msgs.msg import String


def test_nodes_are_known_by_name_and_namespace(bench) -> None:
    node = bench.node("probe", namespace="left")
    bench.node("skin")
    assert bench.spin_until(lambda: len(node.get_node_names()) >= 2)
    assert set(node.get_node_names_and_namespaces()) >= {("probe", "/left"), ("skin", "/")}
    assert set(node.get_fully_qualified_node_names()) >= {"/left/probe", "/skin"}


def test_topics_are_known_with_their_types(bench) -> None:
    node = bench.node("probe", namespace="left")
    node.create_publisher(String, "text", 1)
    node.create_subscription(Image, "/image", print, 1)
    other = bench.node("other")
    assert bench.spin_until(lambda: other.count_subscribers("/image") == 1)
    topics = dict(other.get_topic_names_and_types())
    assert topics["/left/text"] == ["std_msgs/msg/String"]
    assert topics["/image"] == ["sensor_msgs/msg/Image"]
    assert dict(other.get_topic_names_and_types(no_demangle=True))["rt/image"] == [
        "sensor_msgs::msg::dds_::Image_"
    ]
    assert other.count_publishers("/left/text") == 1
    assert other.count_publishers("/image") == 0


def test_endpoints_are_known_in_full(bench) -> None:
    node = bench.node("probe", namespace="left")
    quality = QoSProfile(
        depth=3,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        lifespan=Duration(seconds=2),
    )
    node.create_publisher(Image, "/image", quality)
    node.create_subscription(Image, "/image", print, 1)
    assert bench.spin_until(lambda: node.count_subscribers("/image") == 1)
    (published,) = node.get_publishers_info_by_topic("/image")
    assert (published.node_name, published.node_namespace) == ("probe", "/left")
    assert published.topic_type == "sensor_msgs/msg/Image"
    assert published.endpoint_type is TopicEndpointTypeEnum.PUBLISHER
    assert len(published.endpoint_gid) == 16
    assert published.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
    assert published.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
    assert published.qos_profile.history is HistoryPolicy.KEEP_LAST
    assert published.qos_profile.depth == 3
    assert published.qos_profile.lifespan == Duration(seconds=2)
    assert published.qos_profile.deadline == Infinite
    (subscribed,) = node.get_subscriptions_info_by_topic("rt/image", no_mangle=True)
    assert subscribed.endpoint_type is TopicEndpointTypeEnum.SUBSCRIPTION
    assert node.get_publishers_info_by_topic("/nothing") == []
    assert published != subscribed
    assert published == node.get_publishers_info_by_topic("/image")[0]


def test_what_is_destroyed_is_forgotten(bench) -> None:
    node = bench.node("probe")
    watcher = bench.node("watcher")
    node.create_publisher(String, "text", 1)
    assert bench.spin_until(lambda: watcher.count_publishers("text") == 1)
    bench.executor.remove_node(node)
    node.destroy_node()
    assert bench.spin_until(lambda: watcher.count_publishers("text") == 0)
    assert bench.spin_until(lambda: "probe" not in watcher.get_node_names())


def test_contexts_of_one_process_see_each_other(bench, bench_with) -> None:
    other = bench_with("")
    node, peer = bench.node("probe"), other.node("peer")
    publisher = node.create_publisher(String, "text", 10)
    received: list[String] = []
    peer.create_subscription(String, "text", received.append, 10)
    assert bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data="vein"))
    assert other.spin_until(lambda: received)
    assert bench.spin_until(lambda: set(node.get_node_names()) >= {"probe", "peer"})
    other.close()
    assert bench.spin_until(lambda: publisher.get_subscription_count() == 0)
    assert bench.spin_until(lambda: "peer" not in node.get_node_names())
    assert bench.context.ok()


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


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="ROS 2 has DDS security")
def test_security_that_is_not_there_is_refused_rather_than_left_out(monkeypatch, capfd) -> None:
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    for strategy in ("", "Enforce", "enforce"):
        monkeypatch.setenv("ROS_SECURITY_STRATEGY", strategy)
        context = Context()
        with pytest.raises(RuntimeError, match="ROS_SECURITY_ENABLE is true"):
            context.init([])
        assert not context.ok()
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Permissive")
    with Context() as context:
        assert context.ok()
    assert capfd.readouterr().err.count("in the clear") == 1
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "false")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    with Context() as context:
        assert context.ok()
