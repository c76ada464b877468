"""The tissue's mesh at rest, which comes in two latched messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.errors import MeshError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import tetrahedra_from, vectors_from
from us_sim.nodes.qos import LATCHED
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.meshes.rest_surface import RestSurface


class RestMesh:
    """``tissue/rest`` and ``tissue/tetrahedra``, subscribed to while somebody watches them.

    One serves all who work with the mesh, in the node's thread.

    Args:
        node: that subscribes.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._watchers: list[Callable[[], None]] = []
        self._subscriptions: list[Any] = []
        self._rest: PointCloud2 | None = None
        self._tetrahedra: Int32MultiArray | None = None
        self.mesh: TetrahedralMesh | None = None
        self.surface: RestSurface | None = None  # its outer faces, with their edges

    def watch(self, came: Callable[[], None], is_wanted: bool = True) -> None:
        """Have ``came`` called when there is another mesh, or no longer.

        The mesh that is there is kept, and nobody is called for it.
        """
        if is_wanted == (came in self._watchers):
            return
        if is_wanted:
            self._watchers.append(came)
        else:
            self._watchers.remove(came)
        if bool(self._watchers) == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        if self._watchers:
            self._subscriptions = [
                self._node.create_subscription(
                    PointCloud2, "tissue/rest", self._take_rest, LATCHED
                ),
                self._node.create_subscription(
                    Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra, LATCHED
                ),
            ]

    def _take_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._make(is_complete=False)

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._make(is_complete=True)

    def _make(self, is_complete: bool) -> None:
        """Of the two a mesh, unless the second has still to follow the first of another scene."""
        if self._rest is None or self._tetrahedra is None:
            return
        nodes = vectors_from(self._rest, "patient")
        tetrahedra = tetrahedra_from(self._tetrahedra)
        if tetrahedra.max(initial=-1) + 1 != len(nodes):
            if not is_complete:
                return
            raise MeshError(
                f"the tissue has {len(nodes)} nodes at rest, and its tetrahedra name "
                f"{tetrahedra.max(initial=-1) + 1}: the two are not of the same mesh"
            )
        mesh = TetrahedralMesh(nodes, tetrahedra)
        surface = RestSurface.around(mesh)
        if self.surface is not None and surface.number == self.surface.number:
            return
        self.mesh, self.surface = mesh, surface
        for came in list(self._watchers):
            self._node.guarded(self._node.resolve_topic_name("tissue/rest"), came)()
