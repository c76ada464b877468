"""Write config/policy.xml, what each node may do, from the table of topics.

python docs/security.py

A test compares them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from us_sim.nodes.settings import COMPOSABLE, NODES, PLAYERS
from us_sim.nodes.topics import TOPICS

FILE = Path(__file__).resolve().parents[1] / "config" / "policy.xml"

ASK = ("session_control", "session_monitor", "viewer")
"""Nodes that use the parameters and services of the others."""

TOGETHER = {"session_monitor": "session_control"}
"""Nodes in the process, and so the enclave, of another."""


def policy() -> str:
    """The policy, by sros2's schema 0.2.0."""
    root = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(root, "enclaves")
    profiles: dict[str, ET.Element] = {}
    every = {topic.name for topic in TOPICS}
    placed = [(node, TOGETHER.get(node, node)) for node in sorted({*NODES, *TOGETHER})]
    placed += [(node, "composed") for node in COMPOSABLE]
    for node, name in placed:
        if name not in profiles:
            enclave = ET.SubElement(enclaves, "enclave", path=f"/us_sim/{name}")
            profiles[name] = ET.SubElement(enclave, "profiles")
        profile = ET.SubElement(profiles[name], "profile", ns="/", node=node)
        published = {topic.name for topic in TOPICS if node in topic.publishers}
        heard = {topic.name for topic in TOPICS if node in topic.subscribers}
        if node == "session_player":  # all that a recording may hold
            published |= every
        if node in PLAYERS:
            published.add("/clock")
        if node == "session_recorder":
            heard |= every
        _allow(profile, "topic", "publish", published | {"/rosout", "/parameter_events"})
        _allow(profile, "topic", "subscribe", heard | {"/clock", "/parameter_events"})
        _allow(profile, "service", "reply", {"~/*"})
        _allow(profile, "service", "request", {f"{other}/*" for other in NODES if node in ASK})
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _allow(profile: ET.Element, kind: str, action: str, names: set[str]) -> None:
    if names:
        group = ET.SubElement(profile, f"{kind}s", {action: "ALLOW"})
        for name in sorted(names):
            ET.SubElement(group, kind).text = name


if __name__ == "__main__":
    FILE.write_text(policy(), encoding="utf-8")
