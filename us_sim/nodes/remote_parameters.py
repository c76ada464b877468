"""The parameters of the nodes that pages look at: found, read, followed and set."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.qos import QoSProfile, ReliabilityPolicy

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.remote_node import RemoteNode
from us_sim.viewer.parameter_board import ParameterBoard
from us_sim.viewer.parameters import NodeParameters, Parameter

EVENTS = "/parameter_events"
EVERY_EVENT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""As rclpy publishes them."""
LOOK_S = 0.5
"""How often the graph is looked at for nodes that come, go, or are started again."""


class RemoteParameters:
    """Keeps the board up to date while pages look, and does nothing while none does.

    A node is told from one of the same name that was started later by who publishes its
    parameter events, as the middleware numbers publishers.

    Args:
        node: that asks.
        post: has work done in the thread that spins ``node``; returns a future.
        doors: by the names of nodes, what sets their parameters in place of them.
    """

    def __init__(
        self,
        node: GuardedNode,
        post: Callable[[Callable[[], Any]], Any],
        doors: Mapping[str, Callable[..., Future[str]]] | None = None,
    ) -> None:
        self._doors = doors or {}
        self._node, self._post = node, post
        self._space = node.get_namespace().rstrip("/")
        self._nodes: dict[str, RemoteNode] = {}
        self._timer: Any = None
        self._events: Any = None
        self._told: dict[str, NodeParameters] = {}
        self.board = ParameterBoard(lambda: post(self._look), self._send)

    def close(self) -> None:
        """No answer is waited for any more."""
        for remote in self._nodes.values():
            remote.close()

    def _look(self) -> None:
        watched = self.board.watched
        if not watched:
            self._rest()
            return
        if self._timer is None:
            self._events = self._node.create_subscription(
                ParameterEvent, EVENTS, self._follow, EVERY_EVENT
            )
            self._timer = self._node.create_timer(LOOK_S, self._look)
        there = self._identities()
        for name in watched:
            if name not in self._nodes:
                self._nodes[name] = RemoteNode(self._node, name, self._tell)
            self._nodes[name].look(there.get(f"{self._space}/{name}", frozenset()))

    def _rest(self) -> None:
        """Nobody looks: what is known may change unseen."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._node.destroy_subscription(self._events)
            self._timer = self._events = None
        for remote in self._nodes.values():
            remote.forget()

    def _identities(self) -> dict[str, frozenset[Any]]:
        """What tells the nodes of the graph from others, by their full names."""
        found: dict[str, set[Any]] = defaultdict(set)
        for name, space in self._node.get_node_names_and_namespaces():
            found[f"{space.rstrip('/')}/{name}"].add(name)
        for each in self._node.get_publishers_info_by_topic(EVENTS):
            name = f"{each.node_namespace.rstrip('/')}/{each.node_name}"
            if name in found:
                found[name].add(tuple(each.endpoint_gid))
        return {name: frozenset(identity) for name, identity in found.items()}

    def _follow(self, event: ParameterEvent) -> None:
        space, _, name = event.node.rpartition("/")
        if space == self._space and name in self._nodes and name in self.board.watched:
            self._nodes[name].follow(event)

    def _tell(self, known: NodeParameters) -> None:
        """Pages are told of what is new only."""
        if self._told.get(known.node) != known:
            self._told[known.node] = known
            self.board.tell(known)

    def _send(self, parameter: Parameter, raw: Any) -> Future[str]:
        if parameter.node in self._doors:
            return self._doors[parameter.node](**{parameter.name: raw})
        told: Future[str] = Future()

        def ask() -> None:
            remote = self._nodes.get(parameter.node)
            if remote is None:
                told.set_result(f"{parameter.node} is not looked at any more")
            else:
                remote.set(parameter, raw, told)

        if self._post(ask).cancelled():
            told.set_result("the viewer ends")
        return told
