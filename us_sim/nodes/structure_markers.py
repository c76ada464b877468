"""Shows the structures in the tissue to those who subscribe, and makes none for nobody."""

from __future__ import annotations

import threading
import time

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from numpy.typing import NDArray
from visualization_msgs.msg import MarkerArray

from us_sim.errors import UsSimError
from us_sim.nodes.conversions import nanoseconds_of, structure_markers
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import StructureMarkersSettings
from us_sim.scene.building import Structure, structures_of, volume_of
from us_sim.settings.spelling import counted
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


class StructureMarkers:
    """``tissue/structures``: a TRIANGLE_LIST of each structure, where the tissue has carried it.

    Their surfaces are made when the first subscriber has come, in a thread, while the tissue goes
    on being deformed; in lockstep they are made at once, so that no pose is without. How fine they
    are and how often they are sent are the parameters of `StructureMarkersSettings`.

    Args:
        node: that publishes them, of a scene that has structures.
        mesh: of its tissue.
    """

    def __init__(self, node: SceneNode, mesh: TetrahedralMesh) -> None:
        self._node = node
        self._mesh = mesh
        self._settings = LiveSettings(node, {"markers": Group(StructureMarkersSettings())})
        self._publisher = node.stream(MarkerArray, "tissue/structures")
        self._structures: list[Structure] = []
        self._making: threading.Thread | None = None
        self._sent: int | None = None  # ns, the stamp of the last
        self.state = "not made, nobody subscribes"

    def is_due(self, stamp: TimeMessage) -> bool:
        """Whether somebody subscribes, the surfaces are there, and a marker's time has come."""
        if self._publisher.get_subscription_count() == 0:
            return False
        if self._making is None:
            self.state = "being made"
            self._making = threading.Thread(target=self._make, daemon=True)
            self._making.start()
        if self._node.lockstep:
            self._making.join()
        if self._making.is_alive() or not self._structures:
            return False
        if self._sent is None:
            return True
        since = nanoseconds_of(stamp) - self._sent
        return not 0 <= since < 0.99e9 / self._settings.values["markers"].marker_rate

    def publish(self, nodes: NDArray[np.float64], stamp: TimeMessage) -> None:
        """Send the structures as they are when the tissue's nodes (N, 3) are there, m."""
        self._sent = nanoseconds_of(stamp)
        surfaces = [
            (made.name, (*made.colour, 1.0), made.surface.carry(nodes), made.surface.triangles)
            for made in self._structures
        ]
        self._publisher.publish(structure_markers(surfaces, stamp, "patient"))
        self._node.health.published("tissue/structures")

    def _make(self) -> None:
        began = time.monotonic()
        scene = self._node.scene
        triangles = self._settings.values["markers"].structure_triangles
        try:
            self._structures = list(structures_of(scene, volume_of(scene), self._mesh, triangles))
        except UsSimError as error:
            self.state = str(error)
            self._node.health.problem("structures", f"{error}; no structure is shown")
            return
        except Exception as error:  # so that the thread does not end silently
            self.state = "could not be made"
            self._node.failed("tissue/structures", error)
            return
        count = sum(len(made.surface.triangles) for made in self._structures)
        names = ", ".join(made.name for made in self._structures)
        self.state = f"{names}: {counted(count, 'triangle')}"
        self._node.get_logger().info(
            f"made the surfaces of {self.state}, in {time.monotonic() - began:.1f} s"
        )
