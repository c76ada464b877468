"""Services and clients, the parameter services, and the client for them."""

import threading
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import SetBool, Trigger


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


def test_call_waits_in_another_thread(bench) -> None:
    bench.node("server").create_service(Trigger, "reset", lambda _, r: _with(r, "done"))
    client = bench.node("client").create_client(Trigger, "reset")
    assert ready(bench, client)
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(client.call(Trigger.Request())))
    thread.start()
    assert bench.spin_until(lambda: answers)
    thread.join()
    assert answers[0].message == "done"


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
def test_a_request_of_another_middleware_is_not_answered_and_does_no_harm(bench, capfd) -> None:
    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = request.data
        return response

    bench.node("server").create_service(SetBool, "switch", answer)
    client = bench.node("client").create_client(SetBool, "switch")
    assert ready(bench, client)
    client._endpoint.send_request(b"\0\1\0\0")
    assert bench.result(client.call_async(SetBool.Request(data=True))).success
    assert "a request for /switch is not answered" in capfd.readouterr().err


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
