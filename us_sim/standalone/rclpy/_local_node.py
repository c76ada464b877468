"""What others learn about a node of this process: its name and its endpoints."""

from typing import Any

__all__ = ["LocalNode"]


class LocalNode:
    """A node's name and the identities of its readers and writers."""

    def __init__(self, name: str, namespace: str) -> None:
        self.name = name
        self.namespace = namespace
        self.readers: list[bytes] = []
        self.writers: list[bytes] = []

    def description(self) -> Any:
        """This node as the graph of the transport wants it."""
        from ..graph import GraphNode

        return GraphNode(self.namespace, self.name, tuple(self.readers), tuple(self.writers))
