"""What the viewer knows of the surface on which the probe can be put."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Int32MultiArray

from us_sim.geometry.mesh_faces import boundary_triangles
from us_sim.nodes.conversions import mesh_from, tetrahedra_from, vectors_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import LATCHED
from us_sim.tracking.virtual_hand.rest_surface import RestSurface

__all__ = ["ViewerSurface"]

_PLANE = 0.1
"""m around the origin, of the plane where nothing has a surface."""


class ViewerSurface:
    """The skin at rest; where the scene has none the tissue's upper side, else the plane z = 0.

    Args:
        node: that hears ``skin/mesh``, ``tissue/rest`` and ``tissue/tetrahedra``.
        changed: called when there is another surface.
    """

    def __init__(self, node: GuardedNode, changed: Callable[[], None]) -> None:
        self._node, self._changed = node, changed
        self._skin: RestSurface | None = None
        self._nodes: NDArray[np.float64] | None = None
        self._tetrahedra: NDArray[np.int32] | None = None
        self._tissue: RestSurface | None = None
        self._plane = RestSurface.plane(_PLANE)
        self._heard = [
            node.create_subscription(message_type, topic, take, LATCHED)
            for message_type, topic, take in (
                (Mesh, "skin/mesh", self._take_skin),
                (PointCloud2, "tissue/rest", self._take_nodes),
                (Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra),
            )
        ]

    @property
    def best(self) -> RestSurface | None:
        """The surface; None while one is still awaited."""
        if self._skin is not None and (self._tissue is None or self._is_offered("skin/mesh")):
            return self._skin
        if self._tissue is not None:
            return self._tissue
        is_awaited = self._is_offered("skin/mesh") or self._is_offered("tissue/rest")
        return None if is_awaited else self._plane

    def close(self) -> None:
        """Hear no more."""
        for subscription in self._heard:
            self._node.destroy_subscription(subscription)
        self._heard = []

    def _is_offered(self, topic: str) -> bool:
        return self._node.count_publishers(self._node.resolve_topic_name(topic)) > 0

    def _take_skin(self, message: Mesh) -> None:
        self._skin = RestSurface(*mesh_from(message))
        self._changed()

    def _take_nodes(self, message: PointCloud2) -> None:
        self._nodes = vectors_from(message, "patient")
        self._make_tissue()

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = tetrahedra_from(message)
        self._make_tissue()

    def _make_tissue(self) -> None:
        """The tissue's surface, once both parts are there and go together."""
        nodes: Any = self._nodes
        tetrahedra: Any = self._tetrahedra
        if nodes is None or tetrahedra is None or tetrahedra.max(initial=-1) >= len(nodes):
            return
        self._tissue = RestSurface.upper_side(nodes, boundary_triangles(tetrahedra))
        self._changed()
