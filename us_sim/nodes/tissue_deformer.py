"""Deforms the tissue under the probe."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.errors import SceneError
from us_sim.nodes.conversions import (
    cloud_message,
    pose_from,
    tetrahedra_message,
    wrench_message,
)
from us_sim.nodes.live_tissue import LiveTissue
from us_sim.nodes.process import run_node
from us_sim.nodes.scene_node import SceneNode
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.solvers.frame_budget import frame_limit, shortest, usable_cores

if TYPE_CHECKING:
    from us_sim.nodes.contact_model_publisher import ContactModelPublisher
    from us_sim.nodes.structure_markers import StructureMarkers

ALWAYS = Time()
"""The stamp of what does not change: zero, which tf takes as the latest."""
GO_ON_S = 0.05
"""Time without a pose after which an unfinished frame is gone on with. It is longer than a frame:
an executor serves timers before messages."""
VISIBLE_M = 5e-5
"""How far a node must have moved for the frame that was gone on with to be sent again."""


class TissueDeformer(SceneNode):
    """``probe/pose`` in; ``tissue/nodes``, ``probe/wrench`` out; mesh latched.

    ``tissue/contact_model`` too where a haptic arm needs it, see `ContactModelPublisher`, and
    ``tissue/structures`` where the scene has structures, see `StructureMarkers`.

    Of a frame whose forces are not in balance, as on a computer with too little time, no wrench is
    sent, nor a contact model: it would be several times what the tissue exerts. Diagnostics count
    such frames (``unbalanced``).

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
        if not self.lockstep:
            sending = shortest(lambda: rest.publish(self._cloud(mesh.nodes, ALWAYS)))
            limit = frame_limit(sending, usable_cores())
            self._live.tissue.limit_frames(limit)
            self.get_logger().info(f"a frame may take {1e3 * limit:.1f} ms")
            self.create_timer(GO_ON_S, self._go_on)
        tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
        self._structures: StructureMarkers | None = None
        if self.scene.structures:
            from us_sim.nodes.structure_markers import StructureMarkers

            self._structures = StructureMarkers(self, mesh)
        self._last: PoseStamped | None = None
        self._sent = mesh.nodes  # (N, 3) m
        self._is_balanced = True  # the last frame
        self._unbalanced = 0  # frames
        self._came = 0  # poses since `_go_on` was last called
        self.newest(PoseStamped, "probe/pose", self._deform)
        self.health.state = f"ready with {self._live.tissue.name}"
        self.get_logger().info(self.health.state)

    def _deform(self, message: PoseStamped) -> None:
        self._came += 1
        self._last = message
        self._frame(message)

    def _go_on(self) -> None:
        """While no pose comes: finish what the last frame had no time for."""
        idle, self._came = self._came == 0, 0
        if idle and self._last is not None and not self._live.tissue.is_settled:
            self._frame(self._last, again=True)

    def _frame(self, message: PoseStamped, again: bool = False) -> None:
        """Deform the tissue and send what somebody wants; ``again`` only if it is to be seen."""
        wanted = self._nodes.get_subscription_count() > 0
        felt = self._wrench.get_subscription_count() > 0
        touched = self._contact is not None and self._contact.is_wanted
        stamp = message.header.stamp
        shown = self._structures is not None and self._structures.is_due(stamp)
        if not (wanted or felt or touched or shown):
            return
        pose = pose_from(message, "patient")
        deformation = self._live.deform(pose)
        self._describe(deformation)
        is_felt_anew = deformation.is_balanced and not self._is_balanced
        self._is_balanced = deformation.is_balanced
        is_still = bool(np.abs(deformation.nodes - self._sent).max() < VISIBLE_M)
        if again and is_still and not is_felt_anew:
            return
        self._sent = deformation.nodes
        if wanted:
            self._nodes.publish(self._cloud(deformation.nodes, stamp))
            self.health.published("tissue/nodes", stamp)
        if felt and deformation.is_balanced:
            self._wrench.publish(
                wrench_message(deformation.force, deformation.torque, stamp, "probe")
            )
            self.health.published("probe/wrench")
        if self._contact is not None and touched and deformation.is_balanced:
            self._contact.publish(self._live.tissue, pose, deformation, stamp)
        if self._structures is not None and shown:
            self._structures.publish(deformation.nodes, stamp)

    def _describe(self, deformation: Deformation) -> None:
        """What diagnostics say of a frame."""
        if deformation.inverted:
            self.health.problem("inside out", _inside_out(deformation, self._live.tissue.name))
        self.health.warning = ""
        if not deformation.is_balanced:
            self._unbalanced += 1
            self.health.warning = (
                f"the tissue's forces are not in balance (residual {deformation.residual:.2g}), so "
                f"no force is sent: move the probe more slowly, or give the frames more time"
            )
        force = float(np.linalg.norm(deformation.force))
        self.health.state = self._live.state
        self.health.values = {
            "residual": f"{deformation.residual:.3g}",
            "unbalanced": str(self._unbalanced),
            **({"force": f"{force:.2f}"} if deformation.is_balanced else {}),
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


def _inside_out(deformation: Deformation, name: str) -> str:
    count = deformation.inverted
    sentence = f"{count} {'tetrahedron is' if count == 1 else 'tetrahedra are'} inside out"
    if name == "fem_nonlinear":
        return sentence
    return (
        f"{sentence}: {name} is not made for a press this deep; fem_nonlinear is (set the "
        "parameter solver of tissue_deformer, or tissue.solver in the scene)"
    )


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    return run_node(TissueDeformer, args)


if __name__ == "__main__":
    sys.exit(main())
