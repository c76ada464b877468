"""Remapping rules: which names given in code are replaced by others.

>>> rule = parse_remap_rule("probe:~/image:=/left/image")
>>> rule.node, rule.match, rule.replacement
('probe', '~/image', '/left/image')
>>> remap([rule], TOPIC, "/probe/image", "probe", "/")
'/left/image'
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ._names import expand

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
    """One rule: what kind of name it replaces, for which node (None: all), and by what."""

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
