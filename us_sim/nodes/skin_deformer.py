"""Deformation of the skin membrane under the probe."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from us_sim.nodes.messages import MarkerShape, cloud_message, mesh_message, serialize_marker
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.process import node_main
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import SkinDeformerSettings
from us_sim.recording.decoding import nanoseconds_of, pose_from
from us_sim.scene.building import build_membrane
from us_sim.settings.setting import rules_of
from us_sim.skin.settings import MembraneSettings, SkinSettings

_COLOUR = (0.85, 0.65, 0.55)  # red, green, blue


class SkinDeformer(SceneNode):
    """``probe/pose`` in; ``skin/nodes`` and ``skin/marker`` out; rest surface latched.

    Its own parameters are those of `SkinDeformerSettings`. Those of the membrane may change while
    it runs: it is made anew, and settles under the probe again.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("skin_deformer", **kwargs)
        skin = self.scene.skin or SkinSettings()
        self._settings = LiveSettings(
            self,
            {"markers": SkinDeformerSettings(), "membrane.": skin},
            use=self._use,
            names={"membrane.": rules_of(MembraneSettings)},
        )
        self._membrane = build_membrane(self.scene, self._settings.values["membrane."])
        surface = self._membrane.surface
        self._triangles = surface.triangles
        self._marked = 0
        self.get_logger().info(f"preparing a membrane of {len(surface.vertices)} vertices")
        self._membrane.warm_up()
        self._nodes = self.create_stream_publisher(PointCloud2, "skin/nodes")
        self._marker = self.create_stream_publisher(Marker, "skin/marker")
        rest = self.create_latched_publisher(Mesh, "skin/mesh")
        rest.publish(mesh_message(surface.vertices, surface.triangles))
        self.subscribe(PoseStamped, "probe/pose", self._on_pose, newest=True)
        self.health.state = "ready"
        self.get_logger().info("ready")

    def _use(self, values: dict[str, Any]) -> None:
        if values["membrane."] != self._membrane.settings:
            self._membrane = self._membrane.with_settings(values["membrane."])

    def report_failure(self, where: str, error: Exception) -> None:
        """Count and log a failure, and reset the membrane, which may have been left halfway."""
        super().report_failure(where, error)
        self._membrane.reset()

    def _on_pose(self, message: PoseStamped) -> None:
        wanted = self._nodes.get_subscription_count() > 0
        shown = self._marker.get_subscription_count() > 0 and self._is_marker_due(message)
        if not (wanted or shown):
            return
        stamp = message.header.stamp
        skin = self._membrane.deform(pose_from(message, "patient"))
        if wanted:
            names = ["x", "y", "z", "normal_x", "normal_y", "normal_z"]
            columns = dict(zip(names, [*skin.vertices.T, *skin.normals.T], strict=True))
            self._nodes.publish(cloud_message(columns, stamp, "patient"))
            self.health.count_published("skin/nodes", stamp)
        if shown:
            colour = (*_COLOUR, self._settings.values["markers"].marker_opacity)
            shape = MarkerShape("skin", colour, skin.vertices[self._triangles.ravel()])
            self._marker.publish(serialize_marker(shape, stamp, "patient"))
            self.health.count_published("skin/marker")
        self.health.state = "running"
        self.health.values = {"residual": f"{skin.residual:.3g}", "action": skin.action}

    def _is_marker_due(self, message: PoseStamped) -> bool:
        """Return whether a marker's period has passed since the last, or stamps went back."""
        stamp = nanoseconds_of(message.header.stamp)
        rate = self._settings.values["markers"].marker_rate
        if 0 <= stamp - self._marked < 0.99e9 / rate:
            return False
        self._marked = stamp
        return True


main = node_main(SkinDeformer, __name__)
