"""What nodes see of each other: names, topics, and who is behind them."""

from rclpy.duration import Duration, Infinite
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
