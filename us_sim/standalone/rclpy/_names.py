"""Names of nodes, namespaces, topics and services: which are allowed, expansion and remapping."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from .exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
)

Fault = tuple[str, int] | None  # the sentence that rcl writes, and the index of the character

# Patterns that end with the offending character, and rcl's words.
_NODE_NAME = (
    (r"[^A-Za-z0-9_]", "node name must not contain characters other than alphanumerics or '_'"),
    (r"^[0-9]", "node name must not start with a number"),
    (r"^.{255}(?=.)", "node name length should not exceed '255'"),
)
_TOPIC_NAME = (
    (r"/\Z", "topic name must not end with a forward slash"),
    (r"^[0-9]", "topic name token must not start with a number"),
    (r"[{}]", "topic name must not have a {substitution}, not known without ROS 2"),
    (
        r"[^A-Za-z0-9_/~]",
        "topic name must not contain characters other than alphanumerics, '_', '~', '{', or '}'",
    ),
    (r".~", "topic name must not have tilde '~' unless it is the first character"),
    (
        r"^~[^/](?=.)",
        "topic name must not have a tilde '~' that is not followed by a forward slash '/'",
    ),
    (r"/[0-9]", "topic name token must not start with a number"),
)


def _absolute(kind: str, exception: str, longest: int, subject: str) -> tuple[tuple[str, str], ...]:
    return (
        (r"^[^/]", f"{kind} must be absolute, it must lead with a '/'"),
        (r"/\Z", f"{kind} must not end with a '/'{exception}"),
        (
            r"[^A-Za-z0-9_/]",
            f"{kind} must not contain characters other than alphanumerics, '_', or '/'",
        ),
        (r"^(?:[^/]|/(?![/0-9]))*//", f"{kind} must not contain repeated '/'"),
        (r"/[0-9]", f"{kind} must not have a token that starts with a number"),
        (rf"^.{{{longest}}}(?=.)", f"{subject} should not exceed '{longest}'"),
    )


_NAMESPACE = _absolute("namespace", ", unless only a '/'", 245, "namespace")
_FULL_TOPIC_NAME = _absolute("topic name", "", 247, "topic length")


def _first_fault(name: str, kind: str, rules: tuple[tuple[str, str], ...]) -> Fault:
    if not name:
        return f"{kind} must not be empty", 0
    for pattern, sentence in rules:
        if bad := re.search(pattern, name, re.DOTALL):
            return sentence, bad.end() - 1
    return None


def error_in_node_name(name: str) -> Fault:
    return _first_fault(name, "node name", _NODE_NAME)


def error_in_namespace(name: str) -> Fault:
    """The fault of an absolute namespace, if any."""
    return None if name == "/" else _first_fault(name, "namespace", _NAMESPACE)


def error_in_full_topic_name(name: str) -> Fault:
    """The fault of an expanded topic or service name, if any."""
    return _first_fault(name, "topic name", _FULL_TOPIC_NAME)


def error_in_topic_name(name: str) -> Fault:
    """The fault of a topic or service name as a person writes it, if any."""
    return (
        ("topic name must not be empty string", 0)
        if not name
        else _first_fault(name, "topic name", _TOPIC_NAME)
    )


def require_node_name(name: str) -> None:
    """Raise InvalidNodeNameException when a node name is not allowed."""
    if error := error_in_node_name(name):
        raise InvalidNodeNameException(name, *error)


def require_namespace(namespace: str) -> None:
    """Raise InvalidNamespaceException when an absolute namespace is not allowed."""
    if error := error_in_namespace(namespace):
        raise InvalidNamespaceException(namespace, *error)


def require_topic_name(name: str, *, is_service: bool, is_full: bool = False) -> None:
    """Raise InvalidTopicNameException, or InvalidServiceNameException, when it is not allowed.

    Args:
        is_service: whether it is the name of a service.
        is_full: whether it was expanded, rather than written by a person.
    """
    if error := (error_in_full_topic_name if is_full else error_in_topic_name)(name):
        kind = InvalidServiceNameException if is_service else InvalidTopicNameException
        raise kind(name, *error)


def expand(name: str, node_name: str, namespace: str) -> str:
    """The absolute name of a topic or service for a node in an absolute namespace.

    Raises:
        ValueError: the name, the node's name or the namespace is not allowed.
    """
    for kind, error in (
        (f"topic name '{name}'", error_in_topic_name(name)),
        (f"node name '{node_name}'", error_in_node_name(node_name)),
        (f"node namespace '{namespace}'", error_in_namespace(namespace)),
    ):
        if error:
            raise ValueError(f"{kind} is invalid: {error[0]}")
    prefix = "" if namespace == "/" else namespace
    if name.startswith("~"):
        name = f"{prefix}/{node_name}{name[1:]}"
    return name if name.startswith("/") else f"{prefix}/{name}"


TOPIC, SERVICE, NODE_NAME, NAMESPACE = 1, 2, 4, 8

_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = rf"(?:~/|/)?{_TOKEN}(?:/{_TOKEN})*"
_RULE = re.compile(
    rf"(?:(?P<node>{_TOKEN}):(?!=))?"
    rf"(?:(?:__node|__name):=(?P<name>{_TOKEN})"
    rf"|__ns:=(?P<namespace>/(?:{_TOKEN}/)*(?:{_TOKEN})?)"
    rf"|(?!__(?:ns|node|name):)(?P<scheme>rostopic://|rosservice://)?(?P<match>{_NAME}):=(?P<replacement>{_NAME}))"
)


class RemapSyntaxError(ValueError):
    """Text that is no remapping rule."""


@dataclass(frozen=True)
class RemapRule:
    """One rule: the kinds of names it replaces, for which node (None: all), and the new name."""

    kinds: int  # bits of TOPIC, SERVICE, NODE_NAME, NAMESPACE
    node: str | None
    match: str | None  # relative, private or absolute; None for node names and namespaces
    replacement: str


def parse_remap_rule(text: str) -> RemapRule:
    """Read `[node:]from:=to`, `[node:]__node:=name` or `[node:]__ns:=/namespace`."""
    found = _RULE.fullmatch(text)
    if found is None:
        if "*" in text:
            raise RemapSyntaxError("Wildcards '*' and '**' are not implemented in remap rules")
        raise RemapSyntaxError(
            "Expected [node:]from:=to, [node:]__node:=name or [node:]__ns:=/namespace"
        )
    node = found["node"]
    if found["name"]:
        return RemapRule(NODE_NAME, node, None, found["name"])
    if found["namespace"]:
        namespace = found["namespace"]
        return RemapRule(NAMESPACE, node, None, namespace.rstrip("/") or "/")
    kinds = {"rostopic://": TOPIC, "rosservice://": SERVICE}.get(found["scheme"], TOPIC | SERVICE)
    return RemapRule(kinds, node, found["match"], found["replacement"])


def remap(rules: Sequence[RemapRule], kind: int, name: str, node_name: str, namespace: str) -> str:
    """The absolute name that the first matching rule gives, or the name itself."""
    for rule in rules:
        if (
            rule.kinds & kind
            and rule.match is not None
            and rule.node in (None, node_name)
            and expand(rule.match, node_name, namespace) == name
        ):
            return expand(rule.replacement, node_name, namespace)
    return name


def remap_node(rules: Sequence[RemapRule], kind: int, node_name: str) -> str | None:
    """The node name or namespace that the first matching rule gives, if one does."""
    for rule in rules:
        if rule.kinds & kind and rule.node in (None, node_name):
            return rule.replacement
    return None
