"""Deformation of the tissue under the probe, and of its structures."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import MarkerArray

from us_sim.errors import SceneError, SolverError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import (
    MarkerShape,
    cloud_message,
    contact_model_message,
    serialize_markers,
    tetrahedra_message,
    wrench_message,
)
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.process import node_main
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import StructureMarkersSettings, TissueDeformerSettings
from us_sim.progress import late_progress
from us_sim.recording.decoding import nanoseconds_of, pose_from
from us_sim.scene.building import (
    Structure,
    build_materials,
    build_structures,
    build_tissue_model,
    load_volume,
)
from us_sim.settings.registry import SOLVERS
from us_sim.settings.spelling import format_count
from us_sim.tissue.live_tissue import LiveTissue, TissueMethod
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation
from us_sim.tissue.solvers.frame_budget import FramePace, time_shortest_run
from us_sim.tracking.haptic import ContactModel, rotate_to_patient

OWN = "tissue_deformer"
STRUCTURES = "tissue/structures"
ALWAYS = TimeMessage()  # the stamp of what does not change: zero, which tf takes as the latest
GO_ON_S = 0.05
"""Time without a pose after which an unfinished frame is continued. It is longer than a frame: an
executor serves timers before messages."""
VISIBLE_M = 5e-5  # by which a node must have moved for a continued frame to be published again
PREPARED_CHECK_S = 0.1  # between checks for a method that has been prepared
_MATERIALS = "materials."


class StructureMarkers:
    """``tissue/structures``: a TRIANGLE_LIST of each structure, deformed with the tissue.

    When the first subscriber comes, a thread makes the surfaces; in lockstep the node waits for it.
    Their resolution and rate are the parameters of `StructureMarkersSettings`.
    """

    def __init__(self, node: SceneNode, mesh: TetrahedralMesh) -> None:
        self._node = node
        self._mesh = mesh
        self._settings = LiveSettings(node, {"markers": StructureMarkersSettings()})
        self._publisher = node.create_stream_publisher(MarkerArray, STRUCTURES)
        self._structures: list[Structure] = []
        self._making: threading.Thread | None = None
        self._sent: int | None = None  # ns, the stamp of the last
        self.state = "not made, nobody subscribes"

    def is_due(self, stamp: TimeMessage) -> bool:
        """Return whether somebody subscribes, the surfaces exist, and a marker's period is over."""
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

    def publish_markers(self, nodes: NDArray[np.float64], stamp: TimeMessage) -> None:
        """Publish the structures deformed with the tissue's nodes (N, 3), m."""
        self._sent = nanoseconds_of(stamp)
        shapes = []
        for made in self._structures:
            corners = made.surface.deform_vertices(nodes)[made.surface.triangles.ravel()]
            shapes.append(MarkerShape(made.name, (*made.colour, 1.0), corners))
        self._publisher.publish(serialize_markers(shapes, stamp, "patient"))
        self._node.health.count_published(STRUCTURES)

    def _make(self) -> None:
        began = time.monotonic()
        scene = self._node.scene
        triangles = self._settings.values["markers"].structure_triangles
        try:
            self._structures = list(
                build_structures(scene, load_volume(scene), self._mesh, triangles)
            )
            for made in self._structures:
                made.surface.deform_vertices(self._mesh.nodes)  # or a frame would compile it
        except UsSimError as error:
            self.state = str(error)
            self._node.health.count_problem("structures", f"{error}; no structure is shown")
            return
        except Exception as error:  # so that the thread does not end silently
            self.state = "could not be made"
            self._node.report_failure(STRUCTURES, error)
            return
        count = sum(len(made.surface.triangles) for made in self._structures)
        names = ", ".join(made.name for made in self._structures)
        self.state = f"{names}: {format_count(count, 'triangle')}"
        self._node.get_logger().info(
            f"made the surfaces of {self.state}, in {time.monotonic() - began:.1f} s"
        )


class TissueDeformer(SceneNode):
    """``probe/pose`` in; ``tissue/nodes``, ``probe/wrench`` out; mesh latched.

    For structures also ``tissue/structures``, see `StructureMarkers`, and for a haptic arm
    ``tissue/contact_model``: the wrench at a pose and its derivative.

    A frame whose forces are not in balance, as on a slow computer, has neither wrench nor contact
    model: they would be several times too large. Diagnostics count such frames (``unbalanced``).

    The method, the settings of every method and the materials are parameters that may change while
    running, see `LiveTissue`: a change is prepared while the tissue goes on as it was, or at once
    in lockstep; one that fails is logged and set back. With ``compare_with`` another method runs on
    the same poses, and diagnostics have the distance of its nodes from those published. Once a
    second they estimate the error of the frame's nodes (``discretisation_error_percent``) and,
    while no pose comes, of the force (``force_error_percent``), if the method can.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("tissue_deformer", **kwargs)
        scene, section = self.scene, self.scene.tissue
        if section is None:
            raise SceneError(f"{scene.origin}: tissue: is missing, so nothing can deform")
        given: dict[str, Any] = {OWN: TissueDeformerSettings(solver=section.solver)}
        for name in SOLVERS.importable:
            given[f"{name}."] = section.settings.get(name) or SOLVERS.load_settings(name)()
        for label, material in section.materials.items():
            given[f"{_MATERIALS}{label}."] = material
        # Before the volume, which may take a minute to make.
        self._settings = LiveSettings(self, given, use=self._prepare)
        self._used = dict(self._settings.values)  # what the tissue is deformed by
        self._tissue = self._make_tissue(_method_of(self._used))
        mesh = self._tissue.model.mesh
        self._nodes = self.create_stream_publisher(PointCloud2, "tissue/nodes")
        self._wrench = self.create_stream_publisher(WrenchStamped, "probe/wrench")
        self._contact = None
        if scene.tracker.source.name == "haptic":
            self._contact = self.create_stream_publisher(Float64MultiArray, "tissue/contact_model")
        rest = self.create_latched_publisher(PointCloud2, "tissue/rest")
        tetrahedra = self.create_latched_publisher(Int32MultiArray, "tissue/tetrahedra")
        rest.publish(self._cloud(mesh.nodes, ALWAYS))
        if not self.lockstep:
            seconds = time_shortest_run(lambda: rest.publish(self._cloud(mesh.nodes, ALWAYS)))
            self._pace = FramePace(seconds)
            self.get_logger().info(f"a frame may take {1e3 * self._pace.limit:.1f} ms")
            self.create_timer(GO_ON_S, self._finish_frame)
            self.create_timer(PREPARED_CHECK_S, self._check_prepared)
        tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
        self._structures = StructureMarkers(self, mesh) if scene.structures else None
        self._last: PoseStamped | None = None
        self._sent = mesh.nodes  # (N, 3) m
        self._is_balanced = True  # the last frame
        self._unbalanced = 0  # frames
        self._came = 0  # poses since `_finish_frame` was last called
        self.subscribe(PoseStamped, "probe/pose", self._on_pose, newest=True)
        self._estimated: dict[str, str] = {}  # of a frame since the last report
        self._is_estimate_due = True
        self.health.measure = self._take_estimate
        self.health.state = f"ready with {self._tissue.solver.name}"
        self.get_logger().info(self.health.state)

    def report_failure(self, where: str, error: Exception) -> None:
        """Count and log a failure, and reset the tissue, which may have been left halfway."""
        super().report_failure(where, error)
        if where != STRUCTURES:  # which another thread makes
            self._tissue.reset()

    def _make_tissue(self, method: TissueMethod) -> LiveTissue:
        assert self.scene.tissue is not None
        volume = load_volume(self.scene)
        materials = dict(method.materials)
        scene = replace(self.scene, tissue=replace(self.scene.tissue, materials=materials))
        model = build_tissue_model(scene, volume, self.get_logger().info)
        self.get_logger().info(
            f"preparing {method.solver} for {len(model.mesh.nodes)} nodes, "
            f"{len(model.mesh.tetrahedra)} tetrahedra"
        )
        constants = partial(build_materials, scene, mesh=model.mesh, volume=volume)
        return LiveTissue(model, method, constants, late_progress("preparing the tissue"))

    def _prepare(self, values: dict[str, Any]) -> None:
        """Prepare the method that the parameters ask for."""
        method, own = _method_of(values), values[OWN]
        compared = f" compared with {own.compare_with}" if own.compare_with else ""
        changed = [key for key in values if values[key] != self._used[key]]
        named = [f"{own.solver}{compared}" if key == OWN else key[:-1] for key in changed]
        reason = ", ".join(named)
        self._tissue.prepare_method(method, reason, wait=self.lockstep)
        now = f"{self._tissue.solver.name} goes on"
        self.get_logger().info(f"{reason}: being prepared; {now}" if reason else f"set back: {now}")
        self._check_prepared()
        self.health.publish_report()

    def _check_prepared(self) -> None:
        """Adopt a method that is ready; set the parameters back if it cannot be made."""
        tissue = self._tissue
        before, preparing = tissue.solver.name, tissue.preparation_status
        try:
            adopted = tissue.adopt_prepared()
        except SolverError as error:
            self.health.count_problem("setting", f"{error}; it is set back")
            self._settings.restore_settings(self._used)
        else:
            if adopted:
                self._used = dict(self._settings.values)
                switched = f"switched from {before} to" if tissue.solver.name != before else "with"
                self.get_logger().info(f"{switched} {tissue.solver.name}, as set from now on")
        if preparing or self.health.preparing:
            self.health.preparing = tissue.preparation_status
            self.health.state = self._state

    @property
    def _state(self) -> str:
        """The method in use, and the one that is being prepared."""
        return ", ".join(filter(None, (self._tissue.solver.name, self._tissue.preparation_status)))

    def _on_pose(self, message: PoseStamped) -> None:
        self._came += 1
        self._last = message
        if self._is_wanted(message.header.stamp):
            pose = pose_from(message, "patient")
            limit = None if self.lockstep else self._pace.limit
            self._publish(self._tissue.deform(pose, limit), pose, message.header.stamp)
        self._estimate()  # now that the nodes are sent; it counts as a part of the frame
        if not self.lockstep:
            self._pace.count_frame(1e-9 * (time.monotonic_ns() - self.arrived))

    def _finish_frame(self) -> None:
        """Continue the last frame while no pose comes; publish a visible change."""
        idle, self._came = self._came == 0, 0
        if not idle:
            return
        self._pace.reset()
        last = self._last
        if last and not self._tissue.solver.is_settled and self._is_wanted(last.header.stamp):
            pose, was_balanced = pose_from(last, "patient"), self._is_balanced
            deformation = self._tissue.deform(pose, self._pace.limit)
            is_newly_balanced = deformation.is_balanced and not was_balanced
            if is_newly_balanced or np.abs(deformation.nodes - self._sent).max() >= VISIBLE_M:
                self._publish(deformation, pose, last.header.stamp)
            else:
                self._describe(deformation)
        self._estimate(has_time=True)

    def _is_wanted(self, stamp: TimeMessage) -> bool:
        """Return whether somebody subscribes to a topic of the frame."""
        return bool(
            self._nodes.get_subscription_count()
            or self._wrench.get_subscription_count()
            or self._is_contact_wanted
            or (self._structures is not None and self._structures.is_due(stamp))
        )

    def _publish(self, deformation: Deformation, pose: Pose, stamp: TimeMessage) -> None:
        """Publish a frame on the topics that have subscribers."""
        self._describe(deformation)
        self._sent = deformation.nodes
        if self._nodes.get_subscription_count():
            self._nodes.publish(self._cloud(deformation.nodes, stamp))
            self.health.count_published("tissue/nodes", stamp)
        if deformation.is_balanced and self._wrench.get_subscription_count():
            force, torque = deformation.force, deformation.torque
            self._wrench.publish(wrench_message(force, torque, stamp, "probe"))
            self.health.count_published("probe/wrench")
        if deformation.is_balanced and self._is_contact_wanted:
            self._publish_contact_model(pose, deformation, stamp)
        if self._structures is not None and self._structures.is_due(stamp):
            self._structures.publish_markers(deformation.nodes, stamp)

    @property
    def _is_contact_wanted(self) -> bool:
        return self._contact is not None and self._contact.get_subscription_count() > 0

    def _publish_contact_model(
        self, pose: Pose, deformation: Deformation, stamp: TimeMessage
    ) -> None:
        """Publish the model of the contact at the pose of the last frame."""
        assert self._contact is not None
        wrench = rotate_to_patient(pose, deformation.force, deformation.torque)
        stiffness = None
        with contextlib.suppress(np.linalg.LinAlgError):
            stiffness = self._tissue.solver.compute_contact_stiffness()
        if stiffness is None:
            stiffness = np.zeros((6, 6))
        model = ContactModel(nanoseconds_of(stamp), pose, wrench, stiffness)
        self._contact.publish(contact_model_message(model))
        self.health.count_published("tissue/contact_model")

    def _describe(self, deformation: Deformation) -> None:
        if deformation.inverted:
            tetrahedra = format_count(deformation.inverted, "tetrahedron is", "tetrahedra are")
            self.health.count_problem(
                "inside out",
                f"{tetrahedra} inside out: {self._tissue.solver.name} is not made for a press this "
                f"deep; fem_nonlinear is (set the parameter solver of tissue_deformer, or "
                f"tissue.solver in the scene)",
            )
        self.health.warning = ""
        if not deformation.is_balanced:
            self._unbalanced += 1
            self.health.warning = (
                f"the tissue's forces are not in balance (residual {deformation.residual:.2g}), so "
                f"no force is sent: move the probe more slowly, or give the frames more time"
            )
        force = float(np.linalg.norm(deformation.force))
        self._is_balanced = deformation.is_balanced
        self.health.state = self._state
        self.health.values = {
            "residual": f"{deformation.residual:.3g}",
            "unbalanced": str(self._unbalanced),
            **({"force": f"{force:.2f}"} if deformation.is_balanced else {}),
            "contact_nodes": str(len(deformation.contact_nodes)),
            "action": deformation.action,
            **({"structures": self._structures.state} if self._structures else {}),
        }
        if (apart := self._tissue.difference) is not None:
            self.health.values |= {
                "compared_with": self._tissue.method.compared,
                "difference_max_mm": f"{1e3 * apart.maximum:.4g}",
                "difference_rms_mm": f"{1e3 * apart.rms:.4g}",
            }

    def _estimate(self, *, has_time: bool = False) -> None:
        """Estimate the errors of the first frame after a report; the force's takes a frame long."""
        if self._is_estimate_due:
            self._is_estimate_due = False
            solver = self._tissue.solver
            found = {"discretisation_error_percent": solver.estimate_discretisation_error()}
            if has_time:
                found["force_error_percent"] = solver.estimate_force_error()
            self._estimated = {
                name: f"{100 * error:.2g}" for name, error in found.items() if error is not None
            }

    def _take_estimate(self) -> dict[str, str]:
        self._is_estimate_due = True
        return self._estimated

    def _cloud(self, nodes: Any, stamp: Any) -> PointCloud2:
        x, y, z = nodes.T
        return cloud_message({"x": x, "y": y, "z": z}, stamp, "patient")


def _method_of(values: Mapping[str, Any]) -> TissueMethod:
    """Return the method that the values of the node's parameters, by their keys, ask for."""
    begin = len(_MATERIALS)
    materials = {key[begin:-1]: values[key] for key in values if key.startswith(_MATERIALS)}
    settings = {name: values[f"{name}."] for name in SOLVERS.importable}
    own = values[OWN]
    return TissueMethod(own.solver, own.compare_with or "", settings, materials)


main = node_main(TissueDeformer, __name__)
