"""Parameters of other nodes: found, read, followed and set while pages show them.

The nodes of this package say more in a descriptor than ROS has fields for, as a JSON object in
``additional_constraints``, see `us_sim.nodes.parameters`. Others may write there what they like.
"""

from __future__ import annotations

import json
import time
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent, ParameterType, ParameterValue
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile, ReliabilityPolicy

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.settings.quantity import units_of
from us_sim.viewer.parameters import Kind, NodeParameters, Parameter, ParameterBoard, State

ANSWER_S = 10.0  # how long an answer is waited for: a node that makes images anew may need seconds
_SERVICES_S = 5.0  # how long a node may take to offer its services
_EVERY_S = 0.5  # how often the graph is searched for nodes that come, go, or are started again
_EVENTS = "/parameter_events"
_OF_ROS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""Parameters that rclpy itself declares, or prefixes of them: not what a page is for."""
_TYPES = {
    Kind.TRUTH: (ParameterType.PARAMETER_BOOL, "bool_value"),
    Kind.WHOLE: (ParameterType.PARAMETER_INTEGER, "integer_value"),
    Kind.NUMBER: (ParameterType.PARAMETER_DOUBLE, "double_value"),
    Kind.TEXT: (ParameterType.PARAMETER_STRING, "string_value"),
    Kind.WHOLES: (ParameterType.PARAMETER_INTEGER_ARRAY, "integer_array_value"),
    Kind.NUMBERS: (ParameterType.PARAMETER_DOUBLE_ARRAY, "double_array_value"),
    Kind.TEXTS: (ParameterType.PARAMETER_STRING_ARRAY, "string_array_value"),
}
_KINDS = {number: (kind, field) for kind, (number, field) in _TYPES.items()}


def _parameter(
    node: str, name: str, descriptor: ParameterDescriptor, value: ParameterValue
) -> Parameter:
    kind, raw = _raw(value)
    told = _extras(descriptor)
    unit, reads = str(told.get("unit", "")), str(told.get("shown_in", ""))
    choices = told.get("choices")
    meanings = {str(k): str(v) for k, v in choices.items()} if isinstance(choices, dict) else {}
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    if reads not in units_of(unit):
        reads = unit
    return Parameter(
        node,
        name,
        kind,
        raw,
        unit=reads,
        size=units_of(unit).get(reads, 1.0),
        limits=(float(ranges[0].from_value), float(ranges[0].to_value)) if ranges else None,
        choices=tuple(meanings),
        meanings={name: text for name, text in meanings.items() if text},
        may_be_nothing="none" in told,
        description=str(descriptor.description),
        is_live=not descriptor.read_only and kind is not Kind.OTHER,
    )


def _extras(descriptor: ParameterDescriptor) -> dict[str, Any]:
    """The JSON object in the constraints; empty where another's node has something else there."""
    try:
        told = json.loads(str(descriptor.additional_constraints))
    except (ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}


def _raw(value: ParameterValue) -> tuple[Kind, Any]:
    if value.type not in _KINDS:
        return Kind.OTHER, None
    kind, field = _KINDS[value.type]
    raw = getattr(value, field)
    return kind, tuple(raw) if kind.is_list else raw


def _message(parameter: Parameter, raw: Any) -> ParameterMessage:
    number, field = _TYPES[parameter.kind]
    if parameter.kind.is_list:
        raw = array("d", raw) if parameter.kind is Kind.NUMBERS else list(raw)
    value = ParameterValue(type=number, **{field: raw})
    return ParameterMessage(name=parameter.name, value=value)


class RemoteParameters(ParameterBoard):
    """A board that is up to date while pages show it, and asks nothing while none does.

    A node is told from one of the same name that was started later by who publishes its
    parameter events, as the middleware numbers publishers.

    Args:
        node: that asks.
        post: has work done in the thread that spins ``node``; returns a future.
        doors: by the names of nodes, functions that set their parameters in place of them.
    """

    def __init__(
        self,
        node: GuardedNode,
        post: Callable[[Callable[[], Any]], Any],
        doors: Mapping[str, Callable[..., Future[str]]] | None = None,
    ) -> None:
        super().__init__(lambda: post(self._follow_graph), self._send)
        self._doors = doors or {}
        self._node, self._post = node, post
        self._space = node.get_namespace().rstrip("/")
        self._nodes: dict[str, _RemoteNode] = {}
        self._timer: Any = None
        self._events: Any = None

    def close(self) -> None:
        """Answer whoever waits."""
        for remote in self._nodes.values():
            remote.close()

    def _follow_graph(self) -> None:
        watched = self.watched
        if not watched:
            if self._timer is not None:
                self._node.destroy_timer(self._timer)
                self._node.destroy_subscription(self._events)
                self._timer = None
            for remote in self._nodes.values():
                remote.forget()  # it may change unseen
            return
        if self._timer is None:
            every_event = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
            self._events = self._node.create_subscription(
                ParameterEvent, _EVENTS, self._follow, every_event
            )
            self._timer = self._node.create_timer(_EVERY_S, self._follow_graph)
        there = self._identities()
        for name in watched:
            if name not in self._nodes:
                self._nodes[name] = _RemoteNode(self._node, name, self.tell)
            self._nodes[name].follow_graph(there.get(f"{self._space}/{name}", frozenset()))

    def _identities(self) -> dict[str, frozenset[Any]]:
        """The publishers of parameter events of each node of the graph, by its full name."""
        found: dict[str, set[Any]] = defaultdict(set)
        for name, space in self._node.get_node_names_and_namespaces():
            found[f"{space.rstrip('/')}/{name}"].add(name)
        for each in self._node.get_publishers_info_by_topic(_EVENTS):
            name = f"{each.node_namespace.rstrip('/')}/{each.node_name}"
            if name in found:
                found[name].add(tuple(each.endpoint_gid))
        return {name: frozenset(identity) for name, identity in found.items()}

    def _follow(self, event: ParameterEvent) -> None:
        space, _, name = event.node.rpartition("/")
        if space == self._space and name in self._nodes and name in self.watched:
            self._nodes[name].follow(event)

    def _send(self, parameter: Parameter, raw: Any) -> Future[str]:
        if parameter.node in self._doors:
            return self._doors[parameter.node](**{parameter.name: raw})
        told: Future[str] = Future()

        def ask() -> None:
            remote = self._nodes.get(parameter.node)
            if remote is None:
                told.set_result(f"{parameter.node} is not shown any more")
            else:
                remote.set(parameter, raw, told)

        if self._post(ask).cancelled():
            told.set_result("the viewer ends")
        return told


class _RemoteNode:
    """Another node's parameters. All of it happens in the thread that spins ``node``.

    Args:
        node: that asks.
        name: of the other, in the namespace of ``node``.
        tell: called whenever there is something newer.
    """

    def __init__(self, node: GuardedNode, name: str, tell: Callable[[NodeParameters], None]):
        self._name, self._tell = name, tell
        self._guarded = lambda callback: node.guarded(f"parameters of {name}", callback)
        self._client = AsyncParameterClient(node, f"{node.get_namespace().rstrip('/')}/{name}")
        self._parameters: dict[str, Parameter] = {}
        self._identity: frozenset[Any] = frozenset()
        self._since = 0.0  # s, monotonic: when it was asked, or when it came
        self._reading = 0  # counts; answers to earlier readings are ignored
        self._is_read = self._is_asked = False
        self._heard: Counter[str] = Counter()  # events, by parameters' names
        self._setting: dict[Future[str], float] = {}  # until when its answer is waited for

    def follow_graph(self, identity: frozenset[Any]) -> None:
        """Read the parameters if they are not, or are another process's.

        Args:
            identity: the same as long as the node is; empty where there is no such node.
        """
        now = time.monotonic()
        for told in [told for told, until in self._setting.items() if now > until]:
            del self._setting[told]
            told.set_result(f"{self._name} did not answer within {ANSWER_S:g} s")
        if not identity:
            if self._identity or self._is_asked:
                self.forget()
            self._say(State.ABSENT)
            return
        if identity != self._identity:
            self.forget()
            self._identity, self._since = identity, now
            self._say(State.ASKED)
        if self._is_read or (self._is_asked and now - self._since < ANSWER_S):
            return
        if self._client.services_are_ready():
            self._read()
        elif now - self._since > _SERVICES_S:
            self._say(State.SILENT)

    def forget(self) -> None:
        """Drop what was read."""
        self._identity = frozenset()
        self._parameters = {}
        self._is_read = self._is_asked = False
        self._reading += 1

    def follow(self, event: ParameterEvent) -> None:
        """Take over parameters that were declared, set or undeclared."""
        if not self._is_read:
            if self._is_asked:
                self._read()  # what is being answered may be older
            return
        changed = [*event.new_parameters, *event.changed_parameters]
        if event.deleted_parameters or any(
            each.name not in self._parameters and not each.name.startswith(_OF_ROS)
            for each in changed
        ):
            self._read()
            return
        for each in changed:
            self._heard[each.name] += 1
            if each.name in self._parameters:
                kind, raw = _raw(each.value)
                if kind is not self._parameters[each.name].kind:
                    self._read()  # it is typed dynamically, and has another type now
                    return
                self._parameters[each.name] = self._parameters[each.name].with_raw(raw)
        self._say(State.THERE)

    def set(self, parameter: Parameter, raw: Any, told: Future[str]) -> None:
        """Ask the node to set a parameter; ``told`` gets the reason why not, or an empty text."""
        if not self._client.services_are_ready():
            told.set_result(f"{self._name} offers no parameters at present")
            return
        self._setting[told] = time.monotonic() + ANSWER_S
        heard = self._heard[parameter.name]

        def answered(future: Any) -> None:
            answer = _answer(future)
            if self._setting.pop(told, None) is None:
                return  # it was given up
            if answer is None or not answer.results:
                told.set_result(f"{self._name} did not say whether it took {parameter.name}")
                return
            result = answer.results[0]
            # An event that came before the answer is of this change, or of a later one.
            is_newest = self._heard[parameter.name] == heard
            if result.successful and is_newest and parameter.name in self._parameters:
                known = self._parameters[parameter.name]
                self._parameters[parameter.name] = known.with_raw(raw)
                self._say(State.THERE)
            refused = result.reason or f"{self._name} refuses it"
            told.set_result("" if result.successful else refused)

        self._client.set_parameters([_message(parameter, raw)], callback=self._guarded(answered))

    def close(self) -> None:
        """Answer whoever waits."""
        for told in self._setting:
            told.set_result("the viewer ends")
        self._setting.clear()

    def _read(self) -> None:
        """Ask for all parameters; what is known of them stays until the answers are there."""
        if self._is_asked and time.monotonic() - self._since >= ANSWER_S:
            self._say(State.SILENT)
        self._reading += 1
        self._is_asked, self._since = True, time.monotonic()
        turn = self._reading

        def listed(future: Any) -> None:
            answer = _answer(future)
            if turn == self._reading and answer is not None:
                self._describe(turn, [n for n in answer.result.names if not n.startswith(_OF_ROS)])

        self._client.list_parameters(callback=self._guarded(listed))

    def _describe(self, turn: int, names: list[str]) -> None:
        """Ask for descriptors and values, and tell them once both are there."""
        answers: dict[str, Any] = {}

        def take(what: str, future: Any) -> None:
            answers[what] = _answer(future)
            if turn != self._reading or len(answers) < 2 or None in answers.values():
                return
            descriptors, values = answers["describe"].descriptors, answers["get"].values
            if not len(descriptors) == len(values) == len(names):
                self._leave_out_unset(turn, names)
                return
            self._parameters = {
                name: _parameter(self._name, name, descriptor, value)
                for name, descriptor, value in zip(names, descriptors, values, strict=True)
            }
            self._is_read, self._is_asked = True, False
            self._say(State.THERE)

        guarded = self._guarded
        self._client.describe_parameters(names, callback=guarded(lambda f: take("describe", f)))
        self._client.get_parameters(names, callback=guarded(lambda f: take("get", f)))

    def _leave_out_unset(self, turn: int, names: list[str]) -> None:
        """Ask again without parameters that have a type and no value: with one, none is told."""

        def typed(future: Any) -> None:
            answer = _answer(future)
            if turn != self._reading:
                return
            types = [] if answer is None else list(answer.types)
            told = [name for name, number in zip(names, types, strict=False) if number]
            if 0 < len(told) < len(names):
                self._describe(turn, told)
            else:
                self._is_asked = False  # one was undeclared meanwhile: all is asked anew

        self._client.get_parameter_types(names, callback=self._guarded(typed))

    def _say(self, state: State) -> None:
        self._tell(NodeParameters(self._name, state, dict(self._parameters)))


def _answer(future: Any) -> Any:
    return None if future.cancelled() or future.exception() is not None else future.result()
