"""Who moves the probe, as far as whoever would take it has to know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.viewer.session import SessionState

LEAD_TOPIC = "tracker/pose"
PLAYERS = ("path_player", "session_player")  # nodes that `session_control` starts and ends
VIEWER = "viewer"
NO_PAGE = "no page moves the probe, and nobody else publishes tracker/pose"


@dataclass(frozen=True)
class Lead:
    """Who leads, and whether a page's hand may."""

    who: str  # a node, "tracker" for the scene's own, "hand", or "nobody"
    obstacle: str = ""  # why the hand may not move the probe, for a person; "" if it may
    can_take: bool = False  # whether a page can end what moves it


def probe_lead(node: GuardedNode, session: SessionState, *, is_publishing: bool) -> Lead:
    """Who moves the probe, by who publishes and hears ``tracker/pose``.

    Args:
        node: whose hand would move it.
        session: what is replayed.
        is_publishing: whether that hand publishes already.
    """
    name = node.resolve_topic_name(LEAD_TOPIC)
    others = [info.node_name for info in node.get_publishers_info_by_topic(name)]
    if is_publishing and node.get_name() in others:
        others.remove(node.get_name())
    if others and others[0] in PLAYERS and session.replay:
        what = "moves the probe"
        if session.replay_state == "finished":
            what = "has ended"
            what += " and holds the probe" if others[0] == PLAYERS[0] else ""
        obstacle = f"the replay of {PurePath(session.replay).name} {what}"
        return Lead(others[0], obstacle, can_take=True)
    if others:
        return Lead(others[0], f"{others[0]} moves the probe: end it to take the probe yourself")
    hearers = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    if "probe_tracker" in hearers:
        return Lead("hand")
    if node.count_publishers(node.resolve_topic_name("probe/pose")):
        return Lead(
            "tracker",
            "the probe follows the scene's own tracker: start without --tracker, or with --param "
            "probe_tracker.source=pose, to take it yourself",
        )
    return Lead("nobody", "no simulator with a probe runs yet")


def is_left_by_pages(node: GuardedNode) -> bool:
    """Whether poses stay away because no page is open, where pages could move the probe."""
    name = node.resolve_topic_name(LEAD_TOPIC)
    hearers = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    viewer = (VIEWER, node.get_namespace())
    return (
        "probe_tracker" in hearers
        and not node.count_publishers(name)
        and viewer in node.get_node_names_and_namespaces()
    )
