"""The parameters of all nodes that pages look at; pages and the graph meet here.

>>> from us_sim.viewer.parameter_board import ParameterBoard
>>> board = ParameterBoard(on_watch=lambda: print("somebody looks, or nobody does any more"))
>>> board.watch("tissue_deformer")
somebody looks, or nobody does any more
>>> board.of("tissue_deformer").state.value
'is not running'
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from us_sim.errors import UsSimError
from us_sim.viewer.parameters import NodeParameters, Parameter

Send = Callable[[Parameter, Any], "Future[str]"]
"""Sets a parameter to a value in SI units; the future holds why not, or nothing."""


class ParameterBoard:
    """The newest that is known of each node's parameters, and who looks at them; for any thread.

    Args:
        on_watch: called when a node begins to be looked at, or no longer is.
        send: asks a node to set a parameter.
    """

    def __init__(self, on_watch: Callable[[], None] = lambda: None, send: Send | None = None):
        self._on_watch, self._send = on_watch, send
        self._watched: Counter[str] = Counter()
        self._known: dict[str, NodeParameters] = {}
        self._lock = threading.Lock()

    @property
    def watched(self) -> set[str]:
        """The names of the nodes that are looked at."""
        with self._lock:
            return set(self._watched)

    def watch(self, node: str) -> None:
        """Look at a node's parameters, until `unwatch`."""
        with self._lock:
            self._watched[node] += 1
            first = self._watched[node] == 1
        if first:
            self._on_watch()

    def unwatch(self, node: str) -> None:
        """Look at them no longer."""
        with self._lock:
            self._watched[node] -= 1
            last = self._watched[node] <= 0
            if last:
                del self._watched[node]
        if last:
            self._on_watch()

    def of(self, node: str) -> NodeParameters:
        """What is known; it is another object whenever it has changed."""
        with self._lock:
            return self._known.get(node) or NodeParameters(node)

    def tell(self, known: NodeParameters) -> None:
        """There is something newer of a node."""
        with self._lock:
            self._known[known.node] = known

    def set(self, node: str, name: str, value: Any) -> Future[str]:
        """Set a parameter to a value in the unit that is shown; None is nothing.

        The future holds the reason if it is refused, and an empty text if not.
        """
        parameter = self.of(node).parameters.get(name)
        if parameter is None or self._send is None:
            return _refused(f"{node} has no parameter {name} at present")
        try:
            raw = parameter.raw_of(value)
        except UsSimError as error:
            return _refused(str(error))
        return self._send(parameter, raw)


def _refused(reason: str) -> Future[str]:
    future: Future[str] = Future()
    future.set_result(reason)
    return future
