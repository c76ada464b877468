"""The skin: its triangles once, and where its vertices are."""

from __future__ import annotations

from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import mesh_from, nanoseconds_of, vectors_from
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.viewer_feeds.watched_topic import WatchedTopic
from us_sim.viewer.feed import Feed
from us_sim.viewer.meshes.rest_surface import RestSurface
from us_sim.viewer.packet import Packet


class SkinFeeds:
    """The streams ``skin_mesh``, of ``skin/mesh``, and ``skin``, of ``skin/nodes``."""

    def __init__(self, node: GuardedNode, post: Posted, rate: float) -> None:
        self._surface: RestSurface | None = None
        told = WatchedTopic(node, post, Mesh, "skin/mesh", self._tell, "skin_mesh", None, LATCHED)
        moved = WatchedTopic(node, post, PointCloud2, "skin/nodes", self._move, "skin", rate)
        self.feeds: list[Feed] = [told.feed, moved.feed]

    def _tell(self, message: Mesh, sequence: int) -> Packet:
        self._surface = RestSurface(*mesh_from(message))
        return self._surface.told("skin_mesh", sequence)

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        if self._surface is None:
            return None
        positions = vectors_from(message, "patient")
        stamp = nanoseconds_of(message.header.stamp)
        return self._surface.moved(positions, kind="skin", sequence=sequence, stamp=stamp)
