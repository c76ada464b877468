"""The parameters of one other node: read once, followed, and set."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter_client import AsyncParameterClient

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameter_values import parameter_from, parameter_message, raw_from
from us_sim.viewer.parameters import NodeParameters, Parameter, State

ANSWER_S = 10.0
"""How long an answer is waited for: a node that makes images anew may need seconds."""
SERVICES_S = 5.0
"""How long a node that is there may take to offer its services."""
OF_ROS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""Parameters that rclpy itself declares, or prefixes of them: not what a page is for."""


class RemoteNode:
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
        self._reading = 0  # counts; an answer to an earlier one is of no use
        self._is_read = self._is_asked = False
        self._heard: Counter[str] = Counter()  # events, by parameters' names
        self._setting: dict[Future[str], float] = {}  # until when its answer is waited for

    def look(self, identity: frozenset[Any]) -> None:
        """Read the parameters if they are not, or are another process's.

        Args:
            identity: what is the same as long as the node is; empty where there is no such node.
        """
        now = time.monotonic()
        self._give_up(now)
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
            self.read()
        elif now - self._since > SERVICES_S:
            self._say(State.SILENT)

    def forget(self) -> None:
        """What was read holds no longer."""
        self._identity = frozenset()
        self._parameters = {}
        self._is_read = self._is_asked = False
        self._reading += 1

    def read(self) -> None:
        """Ask for all parameters; what is known of them stays until the answers are there."""
        if self._is_asked and time.monotonic() - self._since >= ANSWER_S:
            self._say(State.SILENT)
        self._reading += 1
        self._is_asked, self._since = True, time.monotonic()
        turn = self._reading

        def listed(future: Any) -> None:
            answer = _answer(future)
            if turn == self._reading and answer is not None:
                names = [n for n in answer.result.names if not n.startswith(OF_ROS)]
                self._describe(turn, names)

        self._client.list_parameters(callback=self._guarded(listed))

    def follow(self, event: ParameterEvent) -> None:
        """Something was declared, set or undeclared."""
        if not self._is_read:
            if self._is_asked:
                self.read()  # what is being answered may be older
            return
        changed = [*event.new_parameters, *event.changed_parameters]
        if event.deleted_parameters or any(
            each.name not in self._parameters and not each.name.startswith(OF_ROS)
            for each in changed
        ):
            self.read()
            return
        for each in changed:
            self._heard[each.name] += 1
            if each.name in self._parameters:
                kind, raw = raw_from(each.value)
                if kind is not self._parameters[each.name].kind:
                    self.read()  # it is typed dynamically, and has another type now
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

        self._client.set_parameters(
            [parameter_message(parameter, raw)], callback=self._guarded(answered)
        )

    def close(self) -> None:
        """Nobody waits for answers any more."""
        for told in self._setting:
            told.set_result("the viewer ends")
        self._setting.clear()

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
            told = zip(names, descriptors, values, strict=True)
            self._parameters = {
                name: parameter_from(self._name, name, descriptor, value)
                for name, descriptor, value in told
            }
            self._is_read, self._is_asked = True, False
            self._say(State.THERE)

        guarded = self._guarded
        self._client.describe_parameters(names, callback=guarded(lambda f: take("describe", f)))
        self._client.get_parameters(names, callback=guarded(lambda f: take("get", f)))

    def _leave_out_unset(self, turn: int, names: list[str]) -> None:
        """Ask again without those that have a type and no value: one of them, and none is told."""

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

    def _give_up(self, now: float) -> None:
        for told in [told for told, until in self._setting.items() if now > until]:
            del self._setting[told]
            told.set_result(f"{self._name} did not answer within {ANSWER_S:g} s")

    def _say(self, state: State) -> None:
        self._tell(NodeParameters(self._name, state, dict(self._parameters)))


def _answer(future: Any) -> Any:
    """The response, or None where there is none."""
    return None if future.cancelled() or future.exception() is not None else future.result()
