"""A body's frame in the tree that ``tf`` and ``tf_static`` make."""

from __future__ import annotations

from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from us_sim.errors import PoseError, SceneError
from us_sim.geometry.pose import FrameTree
from us_sim.nodes.conversions import transform_from
from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.measurement import Measurement

MOVING = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
"""Many nodes share `tf`, this one too: the newest message alone would often be another's."""

STATIC = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class TfInput(TrackerInput):
    """The frame ``tracker.body`` in the frame ``tracker.frame``, each time a frame between moves.

    Its stamp is that of the transform that came: frames between are taken where they last were.
    """

    def __init__(self, device: Device, settings: Any) -> None:
        super().__init__(device, settings)
        tracker = device.scene.tracker
        if tracker.body is None:
            raise SceneError(
                f"{device.scene.origin}: tracker.body: is missing; name the probe's frame in tf"
            )
        if tracker.body == "probe":
            raise SceneError(
                f"{device.scene.origin}: tracker.body: `probe` is the frame that this node "
                f"publishes itself; name the frame that the tracker gives the probe"
            )
        self._frame, self._body = tracker.frame, tracker.body
        self._tree = FrameTree()
        self._fixed: set[str] = set()
        device.listen_to_device(TFMessage, "tf", self._take, MOVING)
        device.listen(TFMessage, "tf_static", self._take_static, STATIC)

    def _take_static(self, message: TFMessage) -> None:
        """Keep what does not move; a way of nothing else makes no poses."""
        self._fixed |= self._keep(message)
        chain = self._tree.chain(self._body, self._frame)
        if chain is not None and self._fixed.issuperset(chain):
            self._device.refuse(
                "frame",
                f"nothing moves in tf between '{self._frame}' and '{self._body}': all of it is in "
                f"tf_static, so no pose comes",
            )

    def _keep(self, message: TFMessage) -> set[str]:
        """Remember the transforms of a message; the frames that have moved."""
        moved = set()
        for transform in message.transforms:
            child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id
            try:
                pose = transform_from(transform)
            except PoseError as error:
                self._device.refuse("pose", f"tf from {parent} to {child}: {error}; it is not used")
                continue
            if self._tree.place(child, parent.lstrip("/"), pose):
                moved.add(child)
        return moved

    def _take(self, message: TFMessage) -> None:
        moved = self._keep(message)
        self._fixed -= moved
        chain = self._tree.chain(self._body, self._frame)
        if chain is None:
            self._device.refuse(
                "frame",
                f"tf has no way from '{self._body}' up to '{self._frame}' yet: see tracker.body "
                f"and tracker.frame in the scene",
            )
            return
        stamps = [
            self._device.stamp_of(transform.header, "tf")
            for transform in message.transforms
            if transform.child_frame_id.lstrip("/") in moved & set(chain)
        ]
        if stamps:
            self._device.take(Measurement(max(stamps), self._tree.pose(chain)))
