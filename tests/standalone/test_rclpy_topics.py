"""Publishers and subscriptions, between nodes of one process and between processes."""

import array
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import (
    InvalidHandle,
    NoTypeSupportImportedException,
    ParameterNotDeclaredException,
)
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Int32, String

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def connected(bench: Any, publisher: Any, subscriptions: int = 1) -> bool:
    return bench.spin_until(lambda: publisher.get_subscription_count() == subscriptions)


def test_messages_arrive_in_order_and_whole(bench) -> None:
    received: list[PoseStamped] = []
    node = bench.node()
    subscription = node.create_subscription(PoseStamped, "pose", received.append, 10)
    publisher = bench.node("tracker").create_publisher(PoseStamped, "pose", 10)
    assert connected(bench, publisher)
    assert subscription.get_publisher_count() == 1
    sent = []
    for index in range(5):
        message = PoseStamped()
        message.header.stamp = TimeMsg(sec=index)
        message.header.frame_id = "patient"
        message.pose.position.z = index / 10
        sent.append(message)
        publisher.publish(message)
    assert bench.spin_until(lambda: len(received) == 5)
    assert received == sent


def test_images_keep_their_bytes(bench) -> None:
    received: list[Image] = []
    node = bench.node()
    node.create_subscription(Image, "image", received.append, 1)
    publisher = node.create_publisher(Image, "image", 1)
    assert connected(bench, publisher)
    pixels = np.arange(512 * 512, dtype=np.uint8).reshape(512, 512)
    publisher.publish(
        Image(height=512, width=512, step=512, data=array.array("B", pixels.tobytes()))
    )
    assert bench.spin_until(lambda: received)
    assert np.array_equal(np.asarray(received[0].data, np.uint8).reshape(512, 512), pixels)


def test_serialized_messages_can_be_published_and_received(bench) -> None:
    messages: list[String] = []
    raw: list[bytes] = []
    node = bench.node()
    node.create_subscription(String, "text", messages.append, 10)
    node.create_subscription(String, "text", raw.append, 10, raw=True)
    publisher = node.create_publisher(String, "text", 10)
    assert connected(bench, publisher, 2)
    data = serialize_message(String(data="vein"))
    publisher.publish(data)
    assert bench.spin_until(lambda: messages and raw)
    assert messages == [String(data="vein")]
    assert isinstance(raw[0], bytes)
    assert raw[0][4 : len(data)] == data[4:]  # middleware may pad, and say so in the header
    assert deserialize_message(raw[0], String) == messages[0]


def test_a_callback_may_ask_where_a_message_came_from(bench) -> None:
    received: list[tuple[String, dict]] = []
    node = bench.node()
    node.create_subscription(String, "text", lambda m, info: received.append((m, info)), 10)
    publisher = node.create_publisher(String, "text", 10)
    assert connected(bench, publisher)
    before = node.get_clock().now().nanoseconds
    publisher.publish(String(data="vein"))
    assert bench.spin_until(lambda: received)
    message, info = received[0]
    assert message.data == "vein"
    assert before <= info["source_timestamp"] <= info["received_timestamp"]
    with pytest.raises(RuntimeError, match="callback should be either be callable"):
        node.create_subscription(String, "text", lambda: None, 10)


def test_what_is_no_message_is_refused(bench) -> None:
    node = bench.node()
    publisher = node.create_publisher(String, "text", 10)
    with pytest.raises(TypeError, match="Expected"):
        publisher.publish("text")
    with pytest.raises(TypeError, match="Expected"):
        publisher.publish(Int32())
    for wrong in (str, print, "std_msgs/msg/String"):
        with pytest.raises((NoTypeSupportImportedException, AttributeError)):
            node.create_publisher(wrong, "text", 10)
    with pytest.raises(TypeError, match="Expected QoSProfile or int"):
        node.create_publisher(String, "text", "reliable")
    with pytest.raises(ValueError, match="greater than or equal to zero"):
        node.create_subscription(String, "text", print, -1)


def test_latched_messages_reach_those_who_come_later_and_others_do_not(bench) -> None:
    node = bench.node()
    latched = node.create_publisher(String, "latched", LATCHED)
    latched.publish(String(data="old"))
    latched.publish(String(data="mesh"))
    passing = node.create_publisher(String, "passing", 10)
    passing.publish(String(data="missed"))
    received: list[String] = []
    late = bench.node("late")
    late.create_subscription(String, "latched", received.append, LATCHED)
    late.create_subscription(String, "passing", received.append, 10)
    assert connected(bench, passing)
    passing.publish(String(data="now"))
    assert bench.spin_until(lambda: len(received) == 2)
    assert {message.data for message in received} == {"mesh", "now"}


def test_keep_last_one_leaves_the_newest(bench) -> None:
    received: list[int] = []
    node = bench.node()
    node.create_subscription(Int32, "count", lambda m: received.append(m.data), 1)
    publisher = node.create_publisher(Int32, "count", 10)
    assert connected(bench, publisher)
    for index in range(20):
        publisher.publish(Int32(data=index))
    assert bench.spin_until(lambda: received and received[-1] == 19)
    assert len(received) <= 2


def test_incompatible_qualities_are_warned_about_by_default(bench, capfd) -> None:
    node = bench.node("probe")
    publisher = node.create_publisher(String, "text", qos_profile_sensor_data)
    received: list[String] = []
    bench.node("strict").create_subscription(String, "text", received.append, 10)
    text = ""
    for _ in range(20):
        bench.spin_until(lambda: False, seconds=0.5)
        text += capfd.readouterr().err  # seldom: what another thread writes meanwhile is lost
        if text.count("Last incompatible policy: RELIABILITY") >= 2:
            break
    assert "[probe]: New subscription discovered on topic 'text', requesting" in text
    assert "[strict]: New publisher discovered on topic 'text', offering" in text
    publisher.publish(String())
    assert publisher.get_subscription_count() == 0
    assert not received


def test_destroyed_endpoints_are_gone(bench) -> None:
    node = bench.node()
    publisher = node.create_publisher(String, "text", 10)
    subscription = node.create_subscription(String, "text", print, 10)
    assert connected(bench, publisher)
    assert subscription in list(node.subscriptions)
    assert node.destroy_subscription(subscription)
    assert not node.destroy_subscription(subscription)
    assert connected(bench, publisher, 0)
    assert node.destroy_publisher(publisher)
    assert not [p for p in node.publishers if p.topic == "text"]
    with pytest.raises(InvalidHandle):
        publisher.publish(String())
    with pytest.raises(InvalidHandle):
        publisher.get_subscription_count()
    assert bench.spin_until(lambda: node.count_publishers("text") == 0)


def test_nothing_is_published_after_shutdown(bench) -> None:
    publisher = bench.node().create_publisher(String, "text", 10)
    bench.context.shutdown()
    with pytest.raises(RuntimeError, match="context is invalid"):
        publisher.publish(String())


def test_quality_of_service_can_be_overridden_by_parameters(bench_with) -> None:
    bench = bench_with(
        [
            "--ros-args",
            "-p",
            "qos_overrides./image.publisher.depth:=3",
            "-p",
            "qos_overrides./image.publisher.reliability:=best_effort",
            "-p",
            "qos_overrides./image.subscription_left.depth:=7",
        ]
    )
    node = bench.node()
    publisher = node.create_publisher(
        String,
        "image",
        QoSProfile(depth=10),
        qos_overriding_options=QoSOverridingOptions.with_default_policies(),
    )
    assert publisher.qos_profile.depth == 3
    assert publisher.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
    assert node.get_parameter("qos_overrides./image.publisher.history").value == "keep_last"
    described = node.describe_parameter("qos_overrides./image.publisher.depth")
    assert described.read_only
    result = node.set_parameters([Parameter("qos_overrides./image.publisher.depth", value=5)])
    assert not result[0].successful
    subscription = node.create_subscription(
        String,
        "image",
        print,
        10,
        qos_overriding_options=QoSOverridingOptions(
            [QoSPolicyKind.DEPTH, QoSPolicyKind.LIFESPAN, QoSPolicyKind.DEADLINE],
            entity_id="left",
        ),
    )
    assert subscription.qos_profile.depth == 7
    assert node.get_parameter("qos_overrides./image.subscription_left.deadline").value == 0
    with pytest.raises(ParameterNotDeclaredException):
        node.get_parameter("qos_overrides./image.subscription_left.lifespan")


def test_overrides_of_quality_can_be_refused(bench_with) -> None:
    bench = bench_with(
        [
            "--ros-args",
            "-p",
            "qos_overrides./a.publisher.depth:=1000",
            "-p",
            "qos_overrides./b.publisher.reliability:=sometimes",
        ]
    )
    node = bench.node()

    def check(profile: QoSProfile) -> SetParametersResult:
        return SetParametersResult(successful=profile.depth < 100, reason="too deep")

    with pytest.raises(InvalidQosOverridesError, match="too deep"):
        node.create_publisher(
            String,
            "a",
            10,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(callback=check),
        )
    with pytest.raises(RuntimeError, match="Unexpected QoS override for policy `reliability`"):
        node.create_publisher(
            String,
            "b",
            10,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )


ECHO = """
import sys
import us_sim.nodes
import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("echo")
publisher = node.create_publisher(String, "answer", 10)
node.create_subscription(String, "question", publisher.publish, 10)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""


def test_processes_exchange_messages(bench) -> None:
    node = bench.node()
    received: list[String] = []
    node.create_subscription(String, "answer", received.append, 10)
    publisher = node.create_publisher(String, "question", 10)
    with subprocess.Popen([sys.executable, "-c", ECHO], env=dict(os.environ)) as other:
        try:
            assert connected(bench, publisher)
            assert bench.spin_until(lambda: node.count_publishers("answer") == 1)
            assert bench.spin_until(lambda: "/echo" in node.get_fully_qualified_node_names())

            def answered() -> list[String]:
                publisher.publish(String(data="vein"))
                return received

            assert bench.spin_until(answered)
            assert received[0].data == "vein"
        finally:
            other.terminate()
            other.wait(timeout=10)
    assert bench.spin_until(lambda: node.count_publishers("answer") == 0)
    assert bench.spin_until(lambda: "/echo" not in node.get_fully_qualified_node_names())
