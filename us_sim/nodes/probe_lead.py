"""Who moves the probe, as far as whoever would take it has to know."""

from __future__ import annotations

from us_sim.nodes.guarded_node import GuardedNode

LEAD_TOPIC = "tracker/pose"
VIEWER = "viewer"
NO_PAGE = "no page moves the probe, and nobody else publishes tracker/pose"


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
