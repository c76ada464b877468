"""The tissue: its outer faces and all its nodes, and how much it is strained."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import PointCloud2

from us_sim.errors import MeshError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import nanoseconds_of, vectors_from
from us_sim.nodes.posted import Posted
from us_sim.nodes.viewer_feeds.rest_mesh import RestMesh
from us_sim.nodes.viewer_feeds.watched_topic import WatchedTopic
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.feed import Feed
from us_sim.viewer.meshes.equivalent_strain import EquivalentStrain
from us_sim.viewer.packet import Packet

_STRAIN_RATE = 12.0
"""Hz: strain takes longer than positions, and its colours are read and not followed."""


class TissueFeeds:
    """The streams ``tissue_mesh``, ``tissue`` and ``strain``, of ``tissue/…``."""

    def __init__(self, node: GuardedNode, post: Posted, rate: float, rest: RestMesh) -> None:
        self._rest = rest
        self._number: int | None = None  # of the mesh that was told
        self._strain: tuple[TetrahedralMesh, EquivalentStrain] | None = None
        self._told = Feed("tissue_mesh", lambda _: post(self._listen), rate=None)
        topic = "tissue/nodes"
        moved = WatchedTopic(node, post, PointCloud2, topic, self._move, "tissue", rate)
        strained = WatchedTopic(
            node, post, PointCloud2, topic, self._be_strained, "strain", min(rate, _STRAIN_RATE)
        )
        self.feeds: list[Feed] = [self._told, moved.feed, strained.feed]

    def _listen(self) -> None:
        """Hear of meshes while a page watches; one may be there already."""
        self._rest.watch(self._offer, self._told.is_watched)
        self._offer()

    def _offer(self) -> None:
        surface = self._rest.surface
        if surface is not None and surface.number != self._number:
            self._number = surface.number
            self._told.offer(lambda sequence: surface.told("tissue_mesh", sequence))

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        surface = self._rest.surface
        if surface is None:
            return None
        positions = vectors_from(message, "patient")
        stamp = nanoseconds_of(message.header.stamp)
        return surface.moved(positions, kind="tissue", sequence=sequence, stamp=stamp)

    def _be_strained(self, message: PointCloud2, sequence: int) -> Packet | None:
        mesh, surface = self._rest.mesh, self._rest.surface
        if mesh is None or surface is None:
            return None
        if self._strain is None or self._strain[0] is not mesh:
            self._strain = mesh, EquivalentStrain(mesh)
        nodes = vectors_from(message, "patient")
        if nodes.shape != mesh.nodes.shape:
            raise MeshError(f"{len(nodes)} nodes came, and the mesh has {len(mesh.nodes)}")
        header = {
            "stamp": str(nanoseconds_of(message.header.stamp)),
            "mesh": surface.number,
            "points": len(nodes),
        }
        values = self._strain[1].of(nodes).astype(np.float32)
        return Packet("strain", sequence, header, values.tobytes())
