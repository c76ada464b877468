"""Deforms the tissue under the probe."""

from __future__ import annotations

import sys
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.assembly import tissue_model_of, volume_of
from us_sim.errors import SceneError, UsSimError
from us_sim.nodes.conversions import (
    cloud_message,
    pose_from,
    tetrahedra_message,
    wrench_message,
)
from us_sim.nodes.process import run_node
from us_sim.nodes.scene_node import SceneNode
from us_sim.tissue.solver import SOLVERS, TissueSolver, create_solver

__all__ = ["TissueDeformer", "main"]

ALWAYS = Time()
"""The stamp of what does not change: zero, which tf takes as the latest."""


class TissueDeformer(SceneNode):
    """``probe/pose`` in; ``tissue/nodes``, ``probe/wrench`` out; mesh latched.

    The parameter ``solver`` switches the method while running; the state is carried over.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("tissue_deformer", **kwargs)
        if self.scene.tissue is None:
            raise SceneError(f"{self.scene.origin}: tissue: is missing, so nothing can deform")
        self._settings = self.scene.tissue.settings
        self._model = tissue_model_of(self.scene, volume_of(self.scene))
        mesh = self._model.mesh
        self._solvers: dict[str, TissueSolver] = {}
        name = self.declare_parameter(
            "solver",
            self.scene.tissue.solver,
            ParameterDescriptor(
                description="method that deforms the tissue; may change while running",
                additional_constraints=f"one of {', '.join(SOLVERS)}",
            ),
        ).value
        self.get_logger().info(
            f"preparing {name} for {len(mesh.nodes)} nodes, {len(mesh.tetrahedra)} tetrahedra"
        )
        self._solver = self._prepared(name)
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._switch)
        self._nodes = self.stream(PointCloud2, "tissue/nodes")
        self._wrench = self.stream(WrenchStamped, "probe/wrench")
        rest = self.latched(PointCloud2, "tissue/rest")
        tetrahedra = self.latched(Int32MultiArray, "tissue/tetrahedra")
        rest.publish(self._cloud(mesh.nodes, ALWAYS))
        tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
        self.newest(PoseStamped, "probe/pose", self._deform)
        self.health.state = f"ready with {name}"
        self.get_logger().info(self.health.state)

    def _prepared(self, name: str) -> TissueSolver:
        """The solver of that name, compiled and ready."""
        if name not in self._solvers:
            solver = create_solver(name, self._model, **self._settings.get(name, {}))
            solver.warm_up()
            self._solvers[name] = solver
        return self._solvers[name]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Prepare a named solver before the switch, so that one that cannot be made is refused."""
        for parameter in parameters:
            if parameter.name == "solver":
                try:
                    self._prepared(parameter.value)
                except UsSimError as error:
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _switch(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "solver" and parameter.value != self._solver.name:
                solver = self._prepared(parameter.value)
                solver.take_over(self._solver.state)
                self._solver = solver
                self.get_logger().info(f"switched to {solver.name}")

    def _deform(self, message: PoseStamped) -> None:
        wanted = self._nodes.get_subscription_count() > 0
        felt = self._wrench.get_subscription_count() > 0
        if not (wanted or felt):
            return
        stamp = message.header.stamp
        try:
            deformation = self._solver.deform(pose_from(message))
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
        self.health.state = self._solver.name
        self.health.values = {
            "residual": f"{deformation.residual:.3g}",
            "contact_nodes": str(len(deformation.contact_nodes)),
            "action": deformation.action,
        }

    def _cloud(self, nodes: Any, stamp: Any) -> PointCloud2:
        x, y, z = nodes.T
        return cloud_message({"x": x, "y": y, "z": z}, stamp, "patient")


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    return run_node(TissueDeformer, args)


if __name__ == "__main__":
    sys.exit(main())
