"""Cuts the B-mode image at the probe's plane through the deformed tissue."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.time import Time
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.assembly import probe_of, volume_of
from us_sim.errors import UsSimError
from us_sim.nodes.conversions import image_message, pose_from, tetrahedra_from, vectors_from
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.scene_node import SceneNode
from us_sim.pose import Pose
from us_sim.slicing.resampling import sample_plane
from us_sim.slicing.row_subdivision import RowSubdivision, warm_up

__all__ = ["SliceInterpolator", "main"]

REMEMBERED = 256
"""Poses kept for the deformed nodes that carry their stamps."""


class SliceInterpolator(SceneNode):
    """``probe/pose`` and, with tissue, ``tissue/nodes`` in; ``ultrasound/image`` out.

    With tissue an image is cut for every set of nodes, at the pose with the same stamp; without,
    for every pose, through the volume as it is.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("slice_interpolator", **kwargs)
        self._volume = volume_of(self.scene)
        self._probe = probe_of(self.scene)
        self.get_logger().info(f"preparing {self.scene.slice.method} on {self.scene.volume_name}")
        warm_up()
        self._cutter: RowSubdivision | None = None
        self._rest: Any = None
        self._tetrahedra: Any = None
        self._poses: dict[int, Pose] = {}
        self._unpaired: PointCloud2 | None = None
        self._images = self.stream(Image, "ultrasound/image")
        if self.scene.tissue is None:
            self.newest(PoseStamped, "probe/pose", self._slice_rigid)
        else:
            self.listen(PointCloud2, "tissue/rest", self._take_rest, LATCHED)
            self.listen(Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra, LATCHED)
            self.listen(PoseStamped, "probe/pose", self._remember)
            self.newest(PointCloud2, "tissue/nodes", self._slice_deformed)
        self.health.state = "ready"
        self.get_logger().info("ready")

    def _take_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._make_cutter()

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._make_cutter()

    def _make_cutter(self) -> None:
        """Once both halves of the mesh are there."""
        if self._rest is None or self._tetrahedra is None:
            return
        try:
            self._cutter = RowSubdivision(
                self._volume,
                vectors_from(self._rest),
                tetrahedra_from(self._tetrahedra),
                regions=self.scene.slice.regions,
                threads=self.threads,
            )
        except UsSimError as error:
            self.health.problem("mesh", f"tissue mesh: {error}")

    def _remember(self, message: PoseStamped) -> None:
        """Keep the pose until the nodes deformed by it arrive."""
        try:
            pose = pose_from(message)
        except UsSimError as error:
            self.health.problem("pose", f"probe/pose: {error}; it is not used")
            return
        self._poses[_nanoseconds(message)] = pose
        while len(self._poses) > REMEMBERED:
            del self._poses[next(iter(self._poses))]
        if self._unpaired is not None and _nanoseconds(self._unpaired) in self._poses:
            self._slice_deformed(self._unpaired)

    def _slice_deformed(self, message: PointCloud2) -> None:
        pose = self._poses.get(_nanoseconds(message))
        if pose is None or self._cutter is None:
            self._unpaired = message
            return
        self._unpaired = None
        if not self._images.get_subscription_count():
            return
        try:
            pixels = self._cutter.image(vectors_from(message), self._probe.plane(pose))
        except UsSimError as error:
            self.health.problem("mesh", f"tissue/nodes: {error}; no image is made of them")
            return
        self._publish(pixels, message)

    def _slice_rigid(self, message: PoseStamped) -> None:
        if not self._images.get_subscription_count():
            return
        try:
            plane = self._probe.plane(pose_from(message))
        except UsSimError as error:
            self.health.problem("pose", f"probe/pose: {error}; no image is made at it")
            return
        self._publish(sample_plane(self._volume, plane), message)

    def _publish(self, pixels: Any, source: PoseStamped | PointCloud2) -> None:
        stamp = source.header.stamp
        self._images.publish(image_message(pixels, stamp, "probe"))
        self.health.published("ultrasound/image", stamp)
        self.health.state = "imaging"


def _nanoseconds(message: PoseStamped | PointCloud2) -> int:
    return Time.from_msg(message.header.stamp).nanoseconds


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    return run_node(SliceInterpolator, args)


if __name__ == "__main__":
    sys.exit(main())
