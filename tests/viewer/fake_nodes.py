"""Nodes of a test's own: it says their parameters, and is handed what a page sets."""

from collections.abc import Callable
from typing import Any

from us_sim.viewer.parameters import Parameter
from us_sim.viewer.remote_parameters import THERE, NodeParameters, RemoteParameters

Take = Callable[[Parameter, Any], str]
"""Gets a parameter that is set and its value in SI units; returns why not, or nothing."""


class FakeNodes(RemoteParameters):
    """In place of the nodes of a graph."""

    def __init__(self, take: Take = lambda *_: "") -> None:
        super().__init__()
        self._take = take

    def tell(self, *parameters: Parameter) -> None:
        """These are the parameters of their node."""
        node = self.get_node(parameters[0].node)
        node.parameters, node.state = {each.name: each for each in parameters}, THERE

    @property
    def watched(self) -> set[str]:
        """The nodes that pages show."""
        return {name for name, node in self._nodes.items() if node.is_watched}

    def _make(self, name: str) -> NodeParameters:
        return FakeNode(name, self._take)


class FakeNode(NodeParameters):
    """In place of one node."""

    def __init__(self, name: str, take: Take) -> None:
        super().__init__(name)
        self._take = take

    async def _send(self, parameter: Parameter, raw: Any) -> str:
        return self._take(parameter, raw)
