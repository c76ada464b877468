"""A node of a scene: its parameters and its health; and who moves the probe."""

from __future__ import annotations

from typing import Any

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import COMPUTING
from us_sim.nodes.settings import VIEWER, SceneNodeSettings
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene


class SceneNode(GuardedNode):
    """A node that works on a scene."""

    live_priority = COMPUTING

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        settings = declare_settings(self, SceneNodeSettings())
        self.scene: Scene = load_scene(settings.scene, volume=settings.volume)
        self.lockstep = settings.lockstep
        self.threads = settings.threads
        is_realtime = settings.realtime and not settings.lockstep
        self.realtime_priority = self.live_priority if is_realtime else 0  # 0: an ordinary process
        self.health = Health(self, self.scene.name)


LEAD_TOPIC = "tracker/pose"
NO_PAGE = "no page moves the probe, and nobody else publishes tracker/pose"
NO_SENDER = "nobody publishes tracker/pose any more"


def explain_missing_poses(node: GuardedNode) -> str:
    """Return why no poses come although no tracker has failed; "" if a tracker must have."""
    name = node.resolve_topic_name(LEAD_TOPIC)
    listeners = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    if "probe_tracker" not in listeners or node.count_publishers(name):
        return ""
    viewer = (VIEWER, node.get_namespace())
    return NO_PAGE if viewer in node.get_node_names_and_namespaces() else NO_SENDER
