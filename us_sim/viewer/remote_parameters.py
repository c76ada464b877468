"""Parameters of other nodes, read, followed and set while pages show them.

A descriptor of this package's nodes has more than ROS has fields for: a JSON object in
``additional_constraints``, see `us_sim.nodes.parameters`. Other nodes may have any text there.
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
from us_sim.nodes.settings import RCLPY_PARAMETERS
from us_sim.settings.quantity import units_of
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.status import PageCounter

ANSWER_S = 10.0  # for an answer: a node that makes images anew may need seconds
LOOK_S = 0.5  # between two looks for nodes that have come, gone, or started again

ABSENT = "is not running"
ASKED = "is being asked for its parameters"
SILENT = "does not answer what its parameters are"
THERE = ""


def make_answer(sentence: str) -> Future[str]:
    """Return a future that holds the sentence already."""
    answer: Future[str] = Future()
    answer.set_result(sentence)
    return answer


def set_atomically(client: AsyncParameterClient, parameters: Sequence[RosParameter]) -> Future[str]:
    """Set all of these parameters or none; the future holds the refusal, or ""."""
    name = client.remote_node_name.rpartition("/")[2]
    if not client.services_are_ready():
        return make_answer(f"{name} offers no parameters at present")
    refusal: Future[str] = Future()

    def on_answer(answer: Any) -> None:
        result = answer.result().result
        if not refusal.done():  # somebody still waits
            refusal.set_result("" if result.successful else result.reason or f"{name} refuses it")

    client.set_parameters_atomically(parameters).add_done_callback(on_answer)
    return refusal


async def await_answer(answer: Future[str], name: str) -> str:
    """Await a node's answer; after `ANSWER_S` return a sentence that it did not answer."""
    try:
        return await asyncio.wait_for(asyncio.wrap_future(answer), ANSWER_S)
    except TimeoutError:
        return f"{name} did not answer within {ANSWER_S:g} s"


ParameterSetter = Callable[..., "Future[str]"]
"""Sets parameters, given by name; the future holds the refusal, or ""."""


class NodeParameters(PageCounter):
    """The parameters of another node, up to date while pages show them.

    The publisher of its parameter events has another number after a restart of the node. Any thread
    may read `state` and `parameters`. The rest is for the event loop that serves the pages, while
    another thread spins the client's node.

    Args:
        name: of the node, within the namespace.
        client: asks the node; None asks nothing.
        setter: sets parameters in place of the client.
    """

    def __init__(
        self,
        name: str,
        client: AsyncParameterClient | None = None,
        setter: ParameterSetter | None = None,
    ) -> None:
        super().__init__(self._on_pages)
        self.name = name
        self.state = ABSENT
        self.parameters: Mapping[str, Parameter] = {}  # by name; another object after each change
        self._client, self._setter = client, setter
        self._following: asyncio.Task[None] | None = None
        self._is_old = asyncio.Event()  # the parameters must be read anew

    def _on_pages(self) -> None:
        """Follow the parameters from the first page that shows them to the last."""
        if self.is_watched and self._client is not None:
            self._following = asyncio.ensure_future(self._follow(self._client))
        elif self._following is not None:
            self._following.cancel()

    async def set_value(self, name: str, value: Any) -> str:
        """Set a parameter to a value in the shown unit; return the refusal, or "".

        Args:
            name: of the parameter.
            value: in the parameter's ``unit``; None is nothing.
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
        if self._setter is not None:
            return await await_answer(self._setter(**{name: raw}), self.name)
        assert self._client is not None  # it has read the parameter
        answer = set_atomically(self._client, [RosParameter(name, parameter.kind.value, raw)])
        refusal = await await_answer(answer, self.name)
        if not refusal and self.parameters.get(name) is parameter:  # nothing newer has come
            self.parameters = {**self.parameters, name: parameter.with_raw(raw)}
        return refusal

    async def _follow(self, client: AsyncParameterClient) -> None:
        """Read the parameters, again after a restart of the node, and follow changes."""
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
        """Read all parameters; keep the old ones until the answers are there."""
        before = self.parameters
        try:
            async with asyncio.timeout(ANSWER_S):
                while not client.services_are_ready():
                    await asyncio.sleep(0.1 * LOOK_S)
                listed = (await _await_result(client.list_parameters())).result.names
                names = [name for name in listed if not name.startswith(RCLPY_PARAMETERS)]
                types = (await _await_result(client.get_parameter_types(names))).types
                # For a parameter without a value rclpy answers with no values at all.
                names = [name for name, type_ in zip(names, types, strict=False) if type_]
                described = (await _await_result(client.describe_parameters(names))).descriptors
                values = (await _await_result(client.get_parameters(names))).values
        except TimeoutError:
            self.state = SILENT
            self._is_old.set()
            return
        if self.parameters is not before:
            self._is_old.set()  # what was answered may be older than an event
        self.state = THERE
        self.parameters = {  # empty where one was undeclared meanwhile
            name: _make_parameter(self.name, name, descriptor, value)
            for name, descriptor, value in zip(names, described, values, strict=False)
        }

    def _update(self, event: ParameterEvent) -> None:
        """Take over new values; have the parameters read anew where some came or went."""
        if event.deleted_parameters:
            self._is_old.set()
        for message in (*event.new_parameters, *event.changed_parameters):
            known = self.parameters.get(message.name)
            kind, raw = _read_value(message.value)
            if known is not None and known.kind is kind:
                self.parameters = {**self.parameters, message.name: known.with_raw(raw)}
            elif not message.name.startswith(RCLPY_PARAMETERS):
                self._is_old.set()


class RemoteParameters:
    """The parameters of all nodes.

    Args:
        node: the node whose clients ask; None asks nothing.
        setters: by a node's name, a function that sets parameters in place of its client.
    """

    def __init__(
        self, node: Node | None = None, setters: Mapping[str, ParameterSetter] | None = None
    ) -> None:
        self._node, self._setters = node, setters or {}
        self._nodes: dict[str, NodeParameters] = {}

    def get_node(self, name: str) -> NodeParameters:
        """Return a node's parameters, always the same object; for any thread."""
        made = self._nodes.get(name)
        return made or self._nodes.setdefault(name, self._make(name))

    def _make(self, name: str) -> NodeParameters:
        if self._node is None:
            return NodeParameters(name)
        space = self._node.get_namespace().rstrip("/")
        client = AsyncParameterClient(self._node, f"{space}/{name}")
        return NodeParameters(name, client, self._setters.get(name))


async def _await_result(request: Any) -> Any:
    """Await, in the running event loop, an answer that comes in the node's thread."""
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[Any] = loop.create_future()

    def deliver() -> None:
        if not answer.done():  # somebody still waits
            answer.set_result(request.result())

    def on_answer(_: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(deliver)

    request.add_done_callback(on_answer)
    return await answer


def _make_parameter(
    node: str, name: str, descriptor: ParameterDescriptor, value: ParameterValue
) -> Parameter:
    """Make a parameter of its descriptor and its value."""
    kind, raw = _read_value(value)
    try:
        more = json.loads(descriptor.additional_constraints)
    except (ValueError, RecursionError):
        more = None
    more = more if isinstance(more, dict) else {}  # a foreign node has something else there
    unit, shown_in = str(more.get("unit", "")), str(more.get("shown_in", ""))
    sizes = units_of(unit)
    shown_in = shown_in if shown_in in sizes else unit
    choices = more.get("choices")
    meanings = {str(k): str(v) for k, v in choices.items()} if isinstance(choices, dict) else {}
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    return Parameter(
        node,
        name,
        kind,
        raw,
        unit=shown_in,
        size=sizes.get(shown_in, 1.0),
        limits=(float(ranges[0].from_value), float(ranges[0].to_value)) if ranges else None,
        choices=tuple(meanings),
        meanings={choice: text for choice, text in meanings.items() if text},
        may_be_nothing="none" in more,
        description=descriptor.description,
        is_live=not descriptor.read_only and kind is not ParameterKind.OTHER,
    )


def _read_value(value: ParameterValue) -> tuple[ParameterKind, Any]:
    """Return the kind and the Python value; lists are tuples."""
    kind, raw = ParameterKind(RosParameter.Type(value.type)), parameter_value_to_python(value)
    if kind is ParameterKind.OTHER:
        return kind, None
    return kind, tuple(raw) if kind.is_list else raw
