"""The score for pages: streams of the node `scorer`, and the pages' requests to it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String
from std_srvs.srv import Trigger

from us_sim.nodes.guarded_node import GuardedNode, loggable_text
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.nodes.topics import FROZEN
from us_sim.recording import MARKER
from us_sim.scoring.settings import STATES
from us_sim.viewer.feeds import make_topic_feed
from us_sim.viewer.stream import CallPoster, Packet, PageSources

SCORE, PICTURE = "score", "score_picture"
"""Streams of an exercise's steps and metrics, and of their picture as PNG."""
_STATES = {DiagnosticStatus.OK: "done", DiagnosticStatus.ERROR: "missed"}


def connect_scorer(node: GuardedNode, post: CallPoster, sources: PageSources) -> None:
    """Add the score's feeds, requests to `scorer`, and marks of frozen images to the sources."""
    marks = node.create_stream_publisher(String, MARKER, STREAM)
    services = {name: node.create_client(Trigger, f"scorer/{name}") for name in ("clear", "draw")}

    def ask(what: str) -> None:
        if services[what].service_is_ready():
            services[what].call_async(Trigger.Request())

    def mark(is_frozen: Any, _: int) -> str | None:
        if is_frozen is True:
            post(lambda: marks.publish(String(data=FROZEN)))
        return None

    sources.commands["frozen"] = mark
    sources.ask_scorer = lambda what: post(lambda: ask(what))
    for message_type, topic, make, kind in (
        (DiagnosticArray, "score", make_score_packet, SCORE),
        (CompressedImage, "score/picture", _make_picture_packet, PICTURE),
    ):
        feed = make_topic_feed(node, post, message_type, topic, make, kind, None, LATCHED)
        sources.add_feeds(feed)


def make_score_packet(message: DiagnosticArray, sequence: int) -> Packet:
    """Make a packet whose header is the document of `us_sim.scoring.result`."""
    first, *others = message.status or [DiagnosticStatus()]
    by_kind: dict[str, list[DiagnosticStatus]] = {}
    for status in others:
        by_kind.setdefault(loggable_text(status.hardware_id), []).append(status)
    plain, about = (by_kind.get(kind, [DiagnosticStatus()])[0] for kind in ("plain", "about"))
    faults = [
        {"seconds": "", "what": loggable_text(each.message), **_read_values(each)}
        for each in by_kind.get("fault", [])
    ]
    state = plain.message if plain.message in STATES else "to lift"
    header = {
        "name": loggable_text(first.name),
        "description": loggable_text(first.message),
        "scene": loggable_text(first.hardware_id),
        "state": state,
        "words": STATES[state],
        "about": {"begun": "", "feedback": "live", **_read_values(about)}
        | {"changed": _find_value(about, "changed")},
        "plain": _read_values(plain),
        "steps": [_read_step(status) for status in by_kind.get("step", [])],
        "faults": faults,
        "metrics": _read_values(first),
    }
    return Packet(SCORE, sequence, header, b"")


def get_score(sources: PageSources) -> Mapping[str, Any]:
    """Return the newest score of the running scene; empty if there is none."""
    feed, state = sources.feeds.get(SCORE), sources.session.state
    packet = feed.get_newest() if feed is not None else None
    is_other = packet is not None and state.is_there and packet.header["scene"] != state.scene
    return {} if packet is None or is_other else packet.header


def is_blind(score: Mapping[str, Any]) -> bool:
    """Return whether the page may show only what a scanner shows, until the exercise ends."""
    is_hidden = score.get("about", {}).get("feedback") == "afterwards"
    return is_hidden and score["state"] not in ("passed", "not passed")


def _read_values(status: DiagnosticStatus) -> dict[str, str]:
    return {loggable_text(each.key): loggable_text(each.value) for each in status.values}


def _find_value(status: DiagnosticStatus, key: str) -> str:
    """Return a value, however long: a line has many points, an attempt many changes."""
    return next((each.value for each in status.values if each.key == key), "")


def _read_step(status: DiagnosticStatus) -> dict[str, Any]:
    step = {"what": loggable_text(status.name), "seen": loggable_text(status.message)}
    step["state"] = _STATES.get(status.level, "to do")
    points = _read_points(_find_value(status, "target"))
    return step | ({"target": points} if points else {})


def _read_points(text: str) -> list[Any]:
    """Read a JSON list of finite points (P, 3), m; empty if the text is no such list."""
    try:
        points = np.array(json.loads(text), np.float64).reshape(-1, 3)
    except (ValueError, TypeError, ArithmeticError, RecursionError):
        return []
    return points.tolist() if np.isfinite(points).all() else []


def _make_picture_packet(message: CompressedImage, sequence: int) -> Packet:
    return Packet(PICTURE, sequence, {}, bytes(message.data))
