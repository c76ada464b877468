"""Deforms the tissue under the probe."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.errors import SceneError, UsSimError
from us_sim.nodes.conversions import (
    cloud_message,
    pose_from,
    tetrahedra_message,
    wrench_message,
)
from us_sim.nodes.live_tissue import LiveTissue
from us_sim.nodes.process import run_node
from us_sim.nodes.scene_node import SceneNode

if TYPE_CHECKING:
    from us_sim.nodes.contact_model_publisher import ContactModelPublisher
    from us_sim.nodes.structure_markers import StructureMarkers

__all__ = ["TissueDeformer", "main"]

ALWAYS = Time()
"""The stamp of what does not change: zero, which tf takes as the latest."""


class TissueDeformer(SceneNode):
    """``probe/pose`` in; ``tissue/nodes``, ``probe/wrench`` out; mesh latched.

    ``tissue/contact_model`` too where a haptic arm needs it, see `ContactModelPublisher`, and
    ``tissue/structures`` where the scene has structures, see `StructureMarkers`.

    The method, the settings of every method and the materials are parameters that may change while
    running, see `LiveTissue`; the state is carried over. With ``compare_with`` another method runs
    on the same poses, and diagnostics say how far its nodes are from those published.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("tissue_deformer", **kwargs)
        if self.scene.tissue is None:
            raise SceneError(f"{self.scene.origin}: tissue: is missing, so nothing can deform")
        self._live = LiveTissue(self)
        mesh = self._live.tissue.model.mesh
        self._nodes = self.stream(PointCloud2, "tissue/nodes")
        self._wrench = self.stream(WrenchStamped, "probe/wrench")
        self._contact: ContactModelPublisher | None = None
        if self.scene.tracker.source.name == "haptic":
            from us_sim.nodes.contact_model_publisher import ContactModelPublisher

            self._contact = ContactModelPublisher(self)
        rest = self.latched(PointCloud2, "tissue/rest")
        tetrahedra = self.latched(Int32MultiArray, "tissue/tetrahedra")
        rest.publish(self._cloud(mesh.nodes, ALWAYS))
        tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
        self._structures: StructureMarkers | None = None
        if self.scene.structures:
            from us_sim.nodes.structure_markers import StructureMarkers

            self._structures = StructureMarkers(self, mesh)
        self.newest(PoseStamped, "probe/pose", self._deform)
        self.health.state = f"ready with {self._live.tissue.name}"
        self.get_logger().info(self.health.state)

    def _deform(self, message: PoseStamped) -> None:
        wanted = self._nodes.get_subscription_count() > 0
        felt = self._wrench.get_subscription_count() > 0
        touched = self._contact is not None and self._contact.is_wanted
        stamp = message.header.stamp
        shown = self._structures is not None and self._structures.is_due(stamp)
        if not (wanted or felt or touched or shown):
            return
        try:
            pose = pose_from(message)
            deformation = self._live.deform(pose)
        except UsSimError as error:
            self.health.problem("pose", f"{error}; the tissue stays as it was")
            return
        if wanted:
            self._nodes.publish(self._cloud(deformation.nodes, stamp))
            self.health.published("tissue/nodes", stamp)
        if felt:
            self._wrench.publish(
                wrench_message(deformation.force, deformation.torque, stamp, "probe")
            )
            self.health.published("probe/wrench")
        if self._contact is not None and touched:
            self._contact.publish(self._live.tissue, pose, deformation, stamp)
        if self._structures is not None and shown:
            self._structures.publish(deformation.nodes, stamp)
        self.health.state = self._live.state
        self.health.values = {
            "residual": f"{deformation.residual:.3g}",
            "contact_nodes": str(len(deformation.contact_nodes)),
            "action": deformation.action,
            **self._comparison(),
            **({"structures": self._structures.state} if self._structures else {}),
        }

    def _comparison(self) -> dict[str, str]:
        """What diagnostics say of the solver beside the one in use."""
        tissue = self._live.tissue
        apart = tissue.difference
        if apart is None:
            return {}
        return {
            "compared_with": tissue.compared,
            "difference_max_mm": f"{1e3 * apart.maximum:.4g}",
            "difference_rms_mm": f"{1e3 * apart.rms:.4g}",
        }

    def _cloud(self, nodes: Any, stamp: Any) -> PointCloud2:
        x, y, z = nodes.T
        return cloud_message({"x": x, "y": y, "z": z}, stamp, "patient")


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    return run_node(TissueDeformer, args)


if __name__ == "__main__":
    sys.exit(main())
