"""Services and clients, the parameter services, and the client for them."""

import threading
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.srv import GetLoggerLevels, GetParameters, ListParameters, SetLoggerLevels
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter, parameter_value_to_python
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


def test_callbacks_may_be_coroutines_that_call_other_services(bench) -> None:
    server = bench.node("server")
    inner = server.create_client(Trigger, "inner")
    server.create_service(Trigger, "inner", lambda _, r: _with(r, "deep"))

    async def outer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answered = await inner.call_async(Trigger.Request())
        return _with(response, f"outer of {answered.message}")

    from rclpy.callback_groups import ReentrantCallbackGroup

    server.create_service(Trigger, "outer", outer, callback_group=ReentrantCallbackGroup())
    client = bench.node("client").create_client(Trigger, "outer")
    assert ready(bench, client)
    assert ready(bench, inner)
    assert bench.result(client.call_async(Trigger.Request())).message == "outer of deep"


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
    client._client._client.send_request(b"\0\1\0\0")
    assert bench.result(client.call_async(SetBool.Request(data=True))).success
    assert "a request for /switch is not answered" in capfd.readouterr().err


def test_the_six_parameter_services(bench) -> None:
    node = bench.node("probe", namespace="left")
    node.declare_parameters("", [("rate", 60.0), ("names", ["vein", "artery"]), ("depth", 3)])
    client = AsyncParameterClient(bench.node("user"), "/left/probe")
    assert client.wait_for_services(timeout_sec=5.0)

    values = bench.result(client.get_parameters(["rate", "names"])).values
    assert [parameter_value_to_python(value) for value in values] == [60.0, ["vein", "artery"]]
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


def test_parameters_are_deleted_and_loaded_from_files(bench, tmp_path) -> None:
    node = bench.node("probe", allow_undeclared_parameters=True)
    client = AsyncParameterClient(bench.node("user"), "probe")
    assert bench.spin_until(client.services_are_ready)
    file = tmp_path / "p.yaml"
    file.write_text("probe: {ros__parameters: {rate: 5.0, image: {width: 512}}}\n")
    done: list[Any] = []
    bench.result(client.load_parameter_file(str(file), callback=done.append))
    assert bench.spin_until(lambda: done)
    assert node.get_parameter("image.width").value == 512
    file.write_text("/**: {ros__parameters: {rate: 6.0}}\n")
    future = client.load_parameter_file_atomically(str(file), use_wildcard=True)
    assert bench.result(future).result.successful
    assert node.get_parameter("rate").value == 6.0
    assert bench.result(client.delete_parameters(["rate"])).results[0].successful
    assert not node.has_parameter("rate")


def test_parameter_events_reach_the_client(bench) -> None:
    node = bench.node("probe")
    node.declare_parameter("rate", 1.0)
    client = AsyncParameterClient(bench.node("user"), "probe")
    events: list[Any] = []
    client.on_parameter_event(events.append)
    assert bench.spin_until(client.services_are_ready)
    assert bench.spin_until(lambda: node.count_subscribers("/parameter_events") >= 1)
    bench.result(client.set_parameters([Parameter("rate", value=2.0)]))
    assert bench.spin_until(
        lambda: any(p.name == "rate" for event in events for p in event.changed_parameters)
    )


def test_a_node_may_have_no_parameter_services(bench) -> None:
    node = bench.node("probe", start_parameter_services=False)
    names = [name for name, _ in node.get_service_names_and_types()]
    assert not [name for name in names if name.endswith("_parameters")]
    assert ListParameters.Request.DEPTH_RECURSIVE == 0
    assert bench.node("user").create_client(GetParameters, "probe/get_parameters")


def test_log_levels_can_be_set_by_services(bench) -> None:
    node = bench.node("probe", enable_logger_service=True)
    user = bench.node("user")
    setting = user.create_client(SetLoggerLevels, "probe/set_logger_levels")
    getting = user.create_client(GetLoggerLevels, "probe/get_logger_levels")
    assert ready(bench, setting)
    assert ready(bench, getting)
    levels = [LoggerLevel(name="probe", level=40), LoggerLevel(name="probe", level=22)]
    results = bench.result(setting.call_async(SetLoggerLevels.Request(levels=levels))).results
    assert [result.successful for result in results] == [True, False]
    assert node.get_logger().get_effective_level() == LoggingSeverity.ERROR
    answer = bench.result(getting.call_async(GetLoggerLevels.Request(names=["probe", "other"])))
    assert [level.level for level in answer.levels] == [40, 0]
    rclpy.logging.set_logger_level("probe", LoggingSeverity.UNSET)


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
