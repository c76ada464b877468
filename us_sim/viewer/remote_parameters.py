"""Parameters of other nodes: read, followed and set while pages show them.

The nodes of this package say more in a descriptor than ROS has fields for, as a JSON object in
``additional_constraints``, see `us_sim.nodes.parameters`. Others may write there what they like.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent, ParameterValue
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from us_sim.errors import SettingsError
from us_sim.settings.quantity import units_of
from us_sim.viewer.parameters import Parameter, ParameterKind

ANSWER_S = 10.0  # how long an answer is waited for: a node that makes images anew may need seconds
LOOK_S = 0.5  # how often it is looked whether a node has come, gone, or been started again
_OF_ROS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""Parameters that rclpy itself declares, or prefixes of them: not what a page is for."""

ABSENT = "is not running"
ASKED = "is being asked for its parameters"
SILENT = "does not answer what its parameters are"
THERE = ""


def make_answer(sentence: str) -> Future[str]:
    """Return a future that holds the sentence already."""
    told: Future[str] = Future()
    told.set_result(sentence)
    return told


def set_atomically(client: AsyncParameterClient, parameters: Sequence[RosParameter]) -> Future[str]:
    """Set all of these parameters, or none; the future holds why not, or nothing."""
    name = client.remote_node_name.rpartition("/")[2]
    if not client.services_are_ready():
        return make_answer(f"{name} offers no parameters at present")
    told: Future[str] = Future()

    def on_answer(answer: Any) -> None:
        result = answer.result().result
        if not told.done():  # somebody waits still
            told.set_result("" if result.successful else result.reason or f"{name} refuses it")

    client.set_parameters_atomically(parameters).add_done_callback(on_answer)
    return told


async def await_answer(told: Future[str], name: str) -> str:
    """Await what a node says, or say that it says nothing."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(told), ANSWER_S)
    except TimeoutError:
        return f"{name} did not answer within {ANSWER_S:g} s"


Door = Callable[..., "Future[str]"]
"""Sets parameters, given by name; the future holds why not, or nothing."""


class NodeParameters:
    """The parameters of another node, up to date while pages show them.

    A node is told from one of the same name that was started later by who publishes its parameter
    events, as the middleware numbers publishers. Any thread may read `state` and `parameters`; the
    rest is for the event loop that serves the pages, while another thread spins the client's node.

    Args:
        name: of the node, within the namespace.
        client: asks the node; without one nothing is asked.
        door: sets parameters in place of the client.
    """

    def __init__(
        self, name: str, client: AsyncParameterClient | None = None, door: Door | None = None
    ) -> None:
        self.name = name
        self.state = ABSENT
        self.parameters: Mapping[str, Parameter] = {}  # by name; another object after each change
        self.pages = 0  # that show them
        self._client, self._door = client, door
        self._following: asyncio.Task[None] | None = None
        self._is_old = asyncio.Event()  # what is known

    def add_page(self) -> None:
        """Follow the parameters, until `remove_page`."""
        self.pages += 1
        if self.pages == 1 and self._client is not None:
            self._following = asyncio.ensure_future(self._follow(self._client))

    def remove_page(self) -> None:
        """Follow them no longer."""
        self.pages -= 1
        if not self.pages and self._following is not None:
            self._following.cancel()

    async def set_value(self, name: str, value: Any) -> str:
        """Set a parameter to a value in the unit that is shown; None is nothing.

        Returns:
            the reason if it is refused, an empty text if not.
        """
        parameter = self.parameters.get(name)
        if parameter is None:
            return f"{self.name} has no parameter {name} at present"
        try:
            return await self._send(parameter, parameter.convert_to_raw(value))
        except SettingsError as error:
            return str(error)

    async def _send(self, parameter: Parameter, raw: Any) -> str:
        name = parameter.name
        if self._door is not None:
            return await await_answer(self._door(**{name: raw}), self.name)
        assert self._client is not None  # which has told of the parameter
        told = set_atomically(self._client, [RosParameter(name, parameter.kind.value, raw)])
        refused = await await_answer(told, self.name)
        if not refused and self.parameters.get(name) is parameter:  # nothing newer has come
            self.parameters = {**self.parameters, name: parameter.with_raw(raw)}
        return refused

    async def _follow(self, client: AsyncParameterClient) -> None:
        """Read the parameters, again whenever they are another process's, and follow changes."""
        loop, is_old, name = asyncio.get_running_loop(), self._is_old, client.remote_node_name

        def on_event(event: ParameterEvent) -> None:
            if event.node == name:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(self._update, event)

        events = client.on_parameter_event(on_event)
        known: set[Any] = set()
        try:
            while True:
                there = {
                    tuple(each.endpoint_gid)
                    for each in client.node.get_publishers_info_by_topic("/parameter_events")
                    if f"{each.node_namespace.rstrip('/')}/{each.node_name}" == name
                }
                if there != known:
                    known, self.parameters, self.state = there, {}, ASKED if there else ABSENT
                    (is_old.set if there else is_old.clear)()
                if is_old.is_set():
                    is_old.clear()
                    await self._read(client)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(is_old.wait(), LOOK_S)
        finally:
            self.parameters, self.state = {}, ABSENT  # they may change unseen
            client.node.destroy_subscription(events)

    async def _read(self, client: AsyncParameterClient) -> None:
        """Ask for all parameters; what is known of them stays until the answers are there."""
        before = self.parameters
        try:
            async with asyncio.timeout(ANSWER_S):
                while not client.services_are_ready():
                    await asyncio.sleep(0.1 * LOOK_S)
                listed = (await _answer(client.list_parameters())).result.names
                names = [name for name in listed if not name.startswith(_OF_ROS)]
                types = (await _answer(client.get_parameter_types(names))).types
                # Of one without a value rclpy tells none, and with it of no other one.
                names = [name for name, type_ in zip(names, types, strict=False) if type_]
                told = (await _answer(client.describe_parameters(names))).descriptors
                values = (await _answer(client.get_parameters(names))).values
        except TimeoutError:
            self.state = SILENT
            self._is_old.set()
            return
        if self.parameters is not before:
            self._is_old.set()  # what was answered may be older than an event
        self.state = THERE
        self.parameters = {  # none where one was undeclared meanwhile
            name: _parameter(self.name, name, descriptor, value)
            for name, descriptor, value in zip(names, told, values, strict=False)
        }

    def _update(self, event: ParameterEvent) -> None:
        """Take over parameters that were declared, set or undeclared."""
        if event.deleted_parameters:
            self._is_old.set()
        for message in (*event.new_parameters, *event.changed_parameters):
            known = self.parameters.get(message.name)
            kind, raw = _value(message.value)
            if known is not None and known.kind is kind:
                self.parameters = {**self.parameters, message.name: known.with_raw(raw)}
            elif not message.name.startswith(_OF_ROS):
                self._is_old.set()


class RemoteParameters:
    """The parameters of all nodes; without ``node``, of none.

    Args:
        node: that asks.
        doors: by the names of nodes, functions that set their parameters in place of them.
    """

    def __init__(self, node: Node | None = None, doors: Mapping[str, Door] | None = None) -> None:
        self._node, self._doors = node, doors or {}
        self._nodes: dict[str, NodeParameters] = {}

    def get_node(self, name: str) -> NodeParameters:
        """Return those of a node, always the same object; any thread may ask."""
        made = self._nodes.get(name)
        return made or self._nodes.setdefault(name, self._make(name))

    def _make(self, name: str) -> NodeParameters:
        if self._node is None:
            return NodeParameters(name)
        space = self._node.get_namespace().rstrip("/")
        client = AsyncParameterClient(self._node, f"{space}/{name}")
        return NodeParameters(name, client, self._doors.get(name))


async def _answer(asked: Any) -> Any:
    """Await an answer in the running event loop that comes in the thread that spins the node."""
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[Any] = loop.create_future()

    def deliver() -> None:
        if not answer.done():  # nobody has given it up
            answer.set_result(asked.result())

    def on_answer(_: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(deliver)

    asked.add_done_callback(on_answer)
    return await answer


def _parameter(
    node: str, name: str, descriptor: ParameterDescriptor, value: ParameterValue
) -> Parameter:
    """Make the parameter of what its node says of it."""
    kind, raw = _value(value)
    try:
        told = json.loads(descriptor.additional_constraints)
    except (ValueError, RecursionError):
        told = None
    told = told if isinstance(told, dict) else {}  # another's node has something else there
    unit, reads = str(told.get("unit", "")), str(told.get("shown_in", ""))
    sizes = units_of(unit)
    reads = reads if reads in sizes else unit
    choices = told.get("choices")
    meanings = {str(k): str(v) for k, v in choices.items()} if isinstance(choices, dict) else {}
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    return Parameter(
        node,
        name,
        kind,
        raw,
        unit=reads,
        size=sizes.get(reads, 1.0),
        limits=(float(ranges[0].from_value), float(ranges[0].to_value)) if ranges else None,
        choices=tuple(meanings),
        meanings={choice: text for choice, text in meanings.items() if text},
        may_be_nothing="none" in told,
        description=descriptor.description,
        is_live=not descriptor.read_only and kind is not ParameterKind.OTHER,
    )


def _value(value: ParameterValue) -> tuple[ParameterKind, Any]:
    """Return a value's kind and its value; lists are tuples."""
    kind, raw = ParameterKind(RosParameter.Type(value.type)), parameter_value_to_python(value)
    if kind is ParameterKind.OTHER:
        return kind, None
    return kind, tuple(raw) if kind.is_list else raw
