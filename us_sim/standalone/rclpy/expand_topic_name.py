"""Make a relative or private topic name absolute."""

from ._names import expand

__all__ = ["expand_topic_name"]


def expand_topic_name(topic_name: str, node_name: str, node_namespace: str) -> str:
    """The absolute name for a node; raises ValueError when one of the names is not allowed."""
    return expand(topic_name, node_name, node_namespace)
