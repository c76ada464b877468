"""Vessels, nerves and bones: heard once, and then carried by the tissue's nodes."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from us_sim.errors import MeshError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import markers_stamp, nanoseconds_of, vectors_from
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import STREAM
from us_sim.nodes.viewer_feeds.marker_surfaces import surfaces_of
from us_sim.nodes.viewer_feeds.rest_mesh import RestMesh
from us_sim.nodes.viewer_feeds.watched_topic import made_of
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.feed import Feed

if TYPE_CHECKING:
    from us_sim.viewer.meshes.carried_surfaces import CarriedSurfaces

_REMEMBERED = 32
_NODES, _STRUCTURES = "tissue/nodes", "tissue/structures"


class StructuresFeed:
    """The stream ``structures``, of ``tissue/structures``.

    That is three megabytes a message, twenty times a second. So it is listened to until one
    message has come whose stamp is also one of ``tissue/nodes``; then it is known where in the
    tissue each vertex lies, and the page moves the structures with the tissue.
    """

    def __init__(self, node: GuardedNode, post: Posted, rest: RestMesh) -> None:
        self._node = node
        self._rest = rest
        self.feed = Feed("structures", lambda _: post(self._listen), rate=None)
        self._post = post
        self._subscriptions: list[Any] = []
        self._nodes: dict[int, bytes] = {}  # by stamp, ns
        self._structures: tuple[int, bytes] | None = None
        self._made_for: int | None = None  # the number of the mesh
        self._making: threading.Thread | None = None

    def _listen(self) -> None:
        """Hear what is wanted now: the mesh while watched, and the rest until it has been used."""
        self._rest.watch(self._listen, self.feed.is_watched)
        surface = self._rest.surface
        if surface is not None and surface.number != self._made_for:
            self.feed.forget()  # what was carried by the last mesh is of another scene
        wanted = (
            self.feed.is_watched
            and surface is not None
            and surface.number != self._made_for
            and self._making is None
        )
        if wanted == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._nodes.clear()
        self._structures = None
        if wanted:
            self._subscriptions = [
                self._node.create_subscription(kind, topic, take, STREAM, raw=True)
                for kind, topic, take in (
                    (PointCloud2, _NODES, self._take_nodes),
                    (MarkerArray, _STRUCTURES, self._take_structures),
                )
            ]

    def _take_nodes(self, data: bytes) -> None:
        message = made_of(self._node, PointCloud2, _NODES, data, lambda message: message)
        if message is None:
            return
        self._nodes[nanoseconds_of(message.header.stamp)] = data
        while len(self._nodes) > _REMEMBERED:
            del self._nodes[next(iter(self._nodes))]
        self._try()

    def _take_structures(self, data: bytes) -> None:
        stamp = markers_stamp(data)
        if stamp is not None:
            self._structures = stamp, data
            self._try()

    def _try(self) -> None:
        if self._structures is None or self._making is not None:
            return
        nodes = self._nodes.get(self._structures[0])
        mesh, surface = self._rest.mesh, self._rest.surface
        if nodes is None or mesh is None or surface is None:
            return
        self._making = threading.Thread(
            target=self._make,
            args=(mesh, surface.number, nodes, self._structures[1]),
            daemon=True,
            name="structures",
        )
        self._making.start()
        self._listen()

    def _make(self, mesh: TetrahedralMesh, number: int, nodes: bytes, structures: bytes) -> None:
        made = made_of(
            self._node,
            PointCloud2,
            _NODES,
            nodes,
            lambda message: TetrahedralMesh(vectors_from(message, "patient"), mesh.tetrahedra),
        )
        carried = None
        if made is not None:
            carried = made_of(
                self._node,
                MarkerArray,
                _STRUCTURES,
                structures,
                lambda message: _carried(message, made),
            )
        self._post(lambda: self._end(number, carried, is_wrong=made is not None))

    def _end(self, number: int, carried: CarriedSurfaces | None, is_wrong: bool) -> None:
        """Offer what was made. Structures that cannot be used are not tried again."""
        self._making = None
        if carried is not None or is_wrong:
            self._made_for = number
        surface = self._rest.surface
        if carried is not None and surface is not None and surface.number == number:
            self.feed.offer(lambda sequence: carried.told("structures", sequence, number))
        self._listen()


def _carried(message: MarkerArray, mesh: TetrahedralMesh) -> CarriedSurfaces:
    surfaces = surfaces_of(message, "patient")
    if not surfaces:
        raise MeshError("there is no triangle in it")
    from us_sim.viewer.meshes.carried_surfaces import CarriedSurfaces  # with its kernels

    return CarriedSurfaces(mesh, surfaces)
