"""Publishers, subscriptions, services and clients, their quality, and the parameter services."""

import os
import subprocess
import sys
import threading
from typing import Any

import pytest
import rclpy
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.exceptions import (
    InvalidHandle,
    NoTypeSupportImportedException,
    ParameterNotDeclaredException,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Int32, String
from std_srvs.srv import SetBool, Trigger

over_dds = pytest.mark.skipif(
    rclpy.get_rmw_implementation_identifier() == "rmw_zenoh_cpp",
    reason="over zenoh every publisher fits every subscription",
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


@over_dds
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


def ready(bench: Any, client: Any) -> bool:
    return bench.spin_until(client.service_is_ready)


def test_a_service_answers_each_request(bench) -> None:
    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = request.data
        response.message = f"it is {request.data}"
        return response

    bench.node("server").create_service(SetBool, "switch", answer)
    client = bench.node("client").create_client(SetBool, "switch")
    assert client.wait_for_service(timeout_sec=5.0)
    futures = [client.call_async(SetBool.Request(data=on)) for on in (True, False)]
    assert [bench.result(future).message for future in futures] == ["it is True", "it is False"]
    assert [future.result().success for future in futures] == [True, False]
    assert client.service_name == "/switch"


def test_several_clients_get_their_own_answers(bench) -> None:
    numbers = iter(range(10))

    def count(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = str(next(numbers))
        return response

    bench.node("server").create_service(Trigger, "count", count)
    clients = [bench.node(f"client_{i}").create_client(Trigger, "count") for i in range(2)]
    assert all(ready(bench, client) for client in clients)
    futures = [client.call_async(Trigger.Request()) for client in clients]
    answers = {bench.result(future).message for future in futures}
    assert answers == {"0", "1"}


def _with(response: Trigger.Response, message: str) -> Trigger.Response:
    response.message = message
    return response


def test_a_service_that_is_not_there_is_not_ready(bench) -> None:
    client = bench.node().create_client(Trigger, "nowhere")
    assert not client.service_is_ready()
    assert not client.wait_for_service(timeout_sec=0.05)
    assert client.call(Trigger.Request(), timeout_sec=0.05) is None
    with pytest.raises(TypeError):
        client.call_async(SetBool.Request())
    with pytest.raises(TypeError):
        client.call(Trigger.Response())


def test_destroyed_services_and_clients_are_gone(bench) -> None:
    server, user = bench.node("server"), bench.node("user")
    service = server.create_service(Trigger, "reset", lambda _, r: r)
    client = user.create_client(Trigger, "reset")
    assert ready(bench, client)
    assert server.destroy_service(service)
    assert not server.destroy_service(service)
    assert bench.spin_until(lambda: not client.service_is_ready())
    assert user.destroy_client(client)
    with pytest.raises(InvalidHandle):
        client.call_async(Trigger.Request())


def test_a_wrong_response_is_an_error_of_the_server(bench) -> None:
    bench.node("server").create_service(Trigger, "reset", lambda _request, _response: None)
    client = bench.node("client").create_client(Trigger, "reset")
    assert ready(bench, client)
    client.call_async(Trigger.Request())
    with pytest.raises(TypeError):
        bench.spin_until(lambda: False, seconds=5)


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="needs the standalone client's insides")
def test_a_request_that_is_cut_off_is_not_answered_and_does_no_harm(bench, capfd) -> None:
    bench.node("server").create_service(SetBool, "switch", _done)
    client = bench.node("client").create_client(SetBool, "switch")
    assert ready(bench, client)
    client._endpoint.send_request(b"\0\1\0\0")
    assert bench.result(client.call_async(SetBool.Request(data=True))).success
    assert "a request for /switch is not answered" in capfd.readouterr().err


def _done(_: Any, response: Any) -> Any:
    response.success = True
    return response


@pytest.mark.skipif(
    rclpy.__name__ == "rclpy" or rclpy.get_rmw_implementation_identifier() != "rmw_cyclonedds_cpp",
    reason="about the mapping of services onto Cyclone DDS",
)
def test_requests_of_fast_dds_are_left_alone_and_told_of_once(bench, capfd) -> None:
    """Its writers' USER_DATA is the type's hash alone, or empty in Humble; it names a request in
    inline QoS, so that the sample is the message alone."""
    from us_sim.standalone.ddsc import EndpointQos
    from us_sim.standalone.transport import Participant

    asked = []
    server = bench.node("server", start_parameter_services=False)
    server.create_service(SetParameters, "set", lambda request, _: asked.append(request))
    server.create_service(SetBool, "switch", _done)
    client = bench.node("client").create_client(SetBool, "switch")
    assert ready(bench, client)

    parameter = Parameter("rate", value=30.0).to_parameter_msg()
    parameters = serialize_message(SetParameters.Request(parameters=[parameter]))
    told = ""
    with Participant(bench.context.get_domain_id()) as participant:
        for service, part, request in (
            ("set", "rcl_interfaces::srv::dds_::SetParameters_Request_", parameters),
            ("switch", "std_srvs::srv::dds_::SetBool_Request_", b"\0\1\0\0\1"),
        ):
            for user_data in (f"typehash=RIHS01_{'0' * 64};", ""):
                arguments = f"rq/{service}Request", part, EndpointQos(depth=10), user_data
                writer = participant.create_writer(*arguments)
                assert bench.spin_until(writer.matched_count)
                assert writer.write(request)
                bench.spin_until(lambda: False, seconds=0.3)
                told += capfd.readouterr().err
    assert bench.result(client.call_async(SetBool.Request(data=True))).success

    (line,) = (told + capfd.readouterr().err).splitlines()
    assert "a request for /set is not answered" in line
    assert "rmw_cyclonedds_cpp" in line
    assert "zenoh" in line
    assert not asked


def test_the_six_parameter_services(bench) -> None:
    node = bench.node("probe", namespace="left")
    node.declare_parameters("", [("rate", 60.0), ("names", ["vein", "artery"]), ("depth", 3)])
    client = AsyncParameterClient(bench.node("user"), "/left/probe")
    assert client.wait_for_services(timeout_sec=5.0)

    values = bench.result(client.get_parameters(["rate", "names"])).values
    assert values[0].double_value == 60.0
    assert values[1].string_array_value == ["vein", "artery"]
    assert not bench.result(client.get_parameters(["rate", "unknown"])).values
    assert list(bench.result(client.get_parameter_types(["rate", "depth"])).types) == [3, 2]
    described = bench.result(client.describe_parameters(["depth"])).descriptors
    assert (described[0].name, described[0].type) == ("depth", 2)
    assert "depth" in bench.result(client.list_parameters()).result.names
    assert list(bench.result(client.list_parameters(["rate"], 1)).result.names) == ["rate"]

    one_by_one = [Parameter("rate", value=30.0), Parameter("depth", value="deep")]
    results = bench.result(client.set_parameters(one_by_one)).results
    assert [result.successful for result in results] == [True, False]
    assert node.get_parameter("rate").value == 30.0
    together = [Parameter("rate", value=10.0).to_parameter_msg(), Parameter("depth", value=1.5)]
    assert not bench.result(client.set_parameters_atomically(together)).result.successful
    assert node.get_parameter("rate").value == 30.0
    unknown = bench.result(client.set_parameters([ParameterMsg(name="unknown")])).results
    assert not unknown[0].successful
    assert "undeclared" in unknown[0].reason


def test_a_node_may_have_no_parameter_services(bench) -> None:
    node = bench.node("probe", start_parameter_services=False)
    assert not [s for s in node.services if s.service_name.endswith("_parameters")]
    assert ListParameters.Request.DEPTH_RECURSIVE == 0
    client = bench.node("user").create_client(GetParameters, "probe/get_parameters")
    assert not client.wait_for_service(timeout_sec=0.2)


def test_a_synchronous_call_works_beside_an_executor_in_a_thread(bench) -> None:
    bench.node("server").create_service(Trigger, "reset", lambda _, r: _with(r, "done"))
    client = bench.node("client").create_client(Trigger, "reset")
    executor: SingleThreadedExecutor = bench.executor
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    assert client.wait_for_service(timeout_sec=5.0)
    answer = client.call(Trigger.Request(), timeout_sec=5.0)
    assert answer is not None
    assert answer.message == "done"
    executor.shutdown()
    thread.join(timeout=5)
    assert not thread.is_alive()
