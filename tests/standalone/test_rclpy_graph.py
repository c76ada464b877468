"""What nodes see of each other: names, topics, services, and who is behind them."""

import pytest
from rclpy._rclpy_pybind11 import NodeNameNonExistentError
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

IMAGE_HASH = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"


def test_nodes_are_known_by_name_and_namespace(bench) -> None:
    node = bench.node("probe", namespace="left")
    bench.node("skin")
    assert bench.spin_until(lambda: len(node.get_node_names()) >= 2)
    assert set(node.get_node_names_and_namespaces()) >= {("probe", "/left"), ("skin", "/")}
    assert set(node.get_fully_qualified_node_names()) >= {"/left/probe", "/skin"}
    assert ("skin", "/", "/") in node.get_node_names_and_namespaces_with_enclaves()
    assert node.wait_for_node("/left/probe", 1.0)
    assert node.wait_for_node("skin", 1.0)
    assert not node.wait_for_node("/nobody", 0.05)


def test_topics_and_services_are_known_with_their_types(bench) -> None:
    node = bench.node("probe", namespace="left")
    node.create_publisher(String, "text", 1)
    node.create_subscription(Image, "/image", print, 1)
    node.create_service(Trigger, "reset", print)
    other = bench.node("other")
    other.create_client(Trigger, "/left/reset")

    def complete() -> bool:
        return other.count_clients("/left/reset") == 1 and other.count_services("/left/reset") == 1

    assert bench.spin_until(complete)
    topics = dict(other.get_topic_names_and_types())
    assert topics["/left/text"] == ["std_msgs/msg/String"]
    assert topics["/image"] == ["sensor_msgs/msg/Image"]
    assert dict(other.get_topic_names_and_types(no_demangle=True))["rt/image"] == [
        "sensor_msgs::msg::dds_::Image_"
    ]
    assert dict(other.get_service_names_and_types())["/left/reset"] == ["std_srvs/srv/Trigger"]
    assert other.count_publishers("/left/text") == 1
    assert other.count_subscribers("/image") == 1
    assert other.count_publishers("/image") == 0
    by_node = dict(other.get_publisher_names_and_types_by_node("probe", "/left"))
    assert by_node["/left/text"] == ["std_msgs/msg/String"]
    assert "/image" not in by_node
    subscribed = other.get_subscriber_names_and_types_by_node("probe", "/left")
    assert ("/image", ["sensor_msgs/msg/Image"]) in subscribed
    offered = other.get_service_names_and_types_by_node("probe", "/left")
    assert ("/left/reset", ["std_srvs/srv/Trigger"]) in offered
    used = other.get_client_names_and_types_by_node("other", "/")
    assert used == [("/left/reset", ["std_srvs/srv/Trigger"])]
    with pytest.raises(NodeNameNonExistentError):
        other.get_publisher_names_and_types_by_node("nobody", "/")


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
    assert str(published.topic_type_hash) == IMAGE_HASH
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
    text = str(published)
    assert text.startswith("Node name: probe\nNode namespace: /left\nTopic type: sensor_msgs")
    assert "Lifespan: 2000000000 nanoseconds" in text
    assert "Deadline: Infinite" in text
    assert published != subscribed
    assert published == node.get_publishers_info_by_topic("/image")[0]
    with pytest.raises(AssertionError):
        TopicEndpointInfo(colour="red")


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
    other = bench_with([])
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
