"""The score as pages see it: streams of what `scorer` says, and what pages ask of it."""

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
from us_sim.nodes.qos import LATCHED, STREAM, qos_override_options
from us_sim.nodes.topics import FROZEN
from us_sim.recording import MARKER
from us_sim.scoring.settings import STATES
from us_sim.viewer.feeds import make_topic_feed
from us_sim.viewer.stream import CallPoster, Packet, Simulator

SCORE, PICTURE = "score", "score_picture"
"""Streams: of an exercise's steps and the metrics, and of their picture as PNG."""
_STATES = {DiagnosticStatus.OK: "done", DiagnosticStatus.ERROR: "missed"}


def connect_scorer(node: GuardedNode, post: CallPoster, simulator: Simulator) -> None:
    """Give pages the score, have them ask `scorer`, and mark when they freeze an image.

    Args:
        node: that listens.
        post: has work done in the thread that spins ``node``.
        simulator: what pages see.
    """
    marks = node.create_publisher(
        String, MARKER, STREAM, qos_overriding_options=qos_override_options()
    )
    services = {name: node.create_client(Trigger, f"scorer/{name}") for name in ("clear", "draw")}

    def ask(what: str) -> None:
        if services[what].service_is_ready():
            services[what].call_async(Trigger.Request())

    def mark(is_frozen: Any, _: int) -> str | None:
        if is_frozen is True:
            post(lambda: marks.publish(String(data=FROZEN)))
        return None

    simulator.commands["frozen"] = mark
    simulator.ask_scorer = lambda what: post(lambda: ask(what))
    simulator.add_feeds(
        make_topic_feed(
            node, post, DiagnosticArray, "score", make_score_packet, SCORE, None, LATCHED
        ),
        make_topic_feed(
            node, post, CompressedImage, "score/picture", _picture, PICTURE, None, LATCHED
        ),
    )


def make_score_packet(message: DiagnosticArray, sequence: int) -> Packet:
    """Return a packet of the document of `us_sim.scoring.result`, without a payload."""
    first, *others = message.status or [DiagnosticStatus()]
    of_kind: dict[str, list[DiagnosticStatus]] = {}
    for status in others:
        of_kind.setdefault(loggable_text(status.hardware_id), []).append(status)
    plain, about = (of_kind.get(kind, [DiagnosticStatus()])[0] for kind in ("plain", "about"))
    faults = [
        {"what": loggable_text(each.message), **_values(each)} for each in of_kind.get("fault", [])
    ]
    state = plain.message if plain.message in STATES else "to lift"
    header = {
        "name": loggable_text(first.name),
        "description": loggable_text(first.message),
        "scene": loggable_text(first.hardware_id),
        "state": state,
        "words": STATES[state],
        "about": {"begun": "", "feedback": "live", **_values(about)},
        "plain": _values(plain),
        "steps": [_step(status) for status in of_kind.get("step", [])],
        "faults": [{"seconds": "", **each} for each in faults],
        "metrics": _values(first),
    }
    return Packet(SCORE, sequence, header, b"")


def get_score(simulator: Simulator) -> Mapping[str, Any]:
    """Return the newest score of the scene that runs; empty where there is none."""
    feed, state = simulator.feeds.get(SCORE), simulator.session.state
    packet = feed.get_newest() if feed is not None else None
    is_other = packet is not None and state.is_there and packet.header["scene"] != state.scene
    return {} if packet is None or is_other else packet.header


def is_blind(told: Mapping[str, Any]) -> bool:
    """Return whether nothing may be shown of a score's scene that a scanner does not show."""
    is_hidden = told.get("about", {}).get("feedback") == "afterwards"
    return is_hidden and told["state"] not in ("passed", "not passed")


def _values(status: DiagnosticStatus) -> dict[str, str]:
    return {loggable_text(each.key): loggable_text(each.value) for each in status.values}


def _step(status: DiagnosticStatus) -> dict[str, Any]:
    step = {"what": loggable_text(status.name), "seen": loggable_text(status.message)}
    step["state"] = _STATES.get(status.level, "to do")
    points = _read_points(_values(status).get("target", ""))
    return step | ({"target": points} if points else {})


def _read_points(text: str) -> list[Any]:
    """Read the finite points (P, 3) m of a JSON list; none where it is no such list."""
    try:
        numbers = np.array(json.loads(text), np.float64).reshape(-1, 3)
    except (ValueError, TypeError, ArithmeticError, RecursionError):
        return []
    return numbers.tolist() if np.isfinite(numbers).all() else []


def _picture(message: CompressedImage, sequence: int) -> Packet:
    return Packet(PICTURE, sequence, {}, bytes(message.data))
