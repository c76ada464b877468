"""Poses from topics: any driver's, one of several bodies, a haptic arm, a SpaceMouse, tf."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from geometry_msgs.msg import PoseArray, PoseStamped, Twist
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool, Header

from us_sim.errors import PoseError, SceneError, TrackingError
from us_sim.geometry.frame_chain import FrameChain
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import TFMessage
from us_sim.nodes.qos import FOREIGN
from us_sim.nodes.tracker_inputs.device import TrackerInput, TrackerNode
from us_sim.recording.decoding import transform_from
from us_sim.settings.spelling import format_count
from us_sim.tracking.haptic import HapticDevice
from us_sim.tracking.measurement import PATIENT, Measurement
from us_sim.tracking.mouse import SixDofMouse
from us_sim.tracking.settings import HapticSettings, SixDofMouseSettings


class PoseInput(TrackerInput):
    """``tracker/pose`` in the frame that the scene names; a driver's, or ``path_player``'s.

    If that is not ``patient``, a pose in ``patient`` is the probe's own: it needs neither
    registration nor calibration.
    """

    def __init__(self, device: TrackerNode, settings: Any) -> None:
        super().__init__(device, settings)
        self._frame = device.scene.tracker.frame
        device.subscribe(PoseStamped, "tracker/pose", self.on_pose, FOREIGN)

    def on_pose(self, message: PoseStamped) -> None:
        """Hand a message's measurement to the tracker."""
        of_probe = message.header.frame_id == PATIENT != self._frame
        frame = PATIENT if of_probe else self._frame
        stamp, pose = self._device.read_measurement(message, "tracker/pose", frame)
        self._device.take_measurement(Measurement(stamp, pose, of_probe=of_probe))


class PoseArrayInput(TrackerInput):
    """The pose ``tracker.entry`` of ``tracker/poses``, in the frame that the scene names."""

    def __init__(self, device: TrackerNode, settings: Any) -> None:
        super().__init__(device, settings)
        self._entry = device.scene.tracker.entry
        device.subscribe(PoseArray, "tracker/poses", self._on_poses, FOREIGN)

    def _on_poses(self, message: PoseArray) -> None:
        if self._entry >= len(message.poses):
            self._device.refuse_measurement(
                "entry",
                f"tracker/poses holds {format_count(len(message.poses), 'pose')}, so none is "
                f"number {self._entry} (from 0): set tracker.entry in the scene",
            )
            return
        entry = PoseStamped(header=message.header, pose=message.poses[self._entry])
        stamp, pose = self._device.read_measurement(entry, "tracker/poses")
        self._device.take_measurement(Measurement(stamp, pose))


class HapticInput(TrackerInput):
    """``haptic/pose`` in the frame that the scene names; ``haptic/clutch`` holds the probe."""

    def __init__(self, device: TrackerNode, settings: HapticSettings) -> None:
        super().__init__(device, settings)
        self._handle = HapticDevice(settings)
        device.subscribe(PoseStamped, "haptic/pose", self._on_pose, FOREIGN)
        device.subscribe(Bool, "haptic/clutch", lambda m: self._handle.set_clutch(m.data), FOREIGN)

    def reset(self) -> None:
        """Forget the clutch."""
        self._handle.reset()

    def _on_pose(self, message: PoseStamped) -> None:
        stamp, pose = self._device.read_measurement(message, "haptic/pose")
        self._device.take_measurement(self._handle.measure_body(pose, stamp))


class SixDofMouseInput(TrackerInput):
    """``spacenav/joy``, or ``spacenav/twist`` where there is no joystick message."""

    def __init__(self, device: TrackerNode, settings: SixDofMouseSettings) -> None:
        super().__init__(device, settings)
        self._mouse = SixDofMouse(settings)
        self._has_joy = False
        device.subscribe(Joy, "spacenav/joy", self._on_joy, FOREIGN)
        device.subscribe(Twist, "spacenav/twist", self._on_twist, FOREIGN)

    def reset(self) -> None:
        """Bring the probe home."""
        self._mouse.reset()

    def _on_joy(self, message: Joy) -> None:
        self._has_joy = True
        stamp = self._device.stamp_of(message.header, "spacenav/joy")
        self._take_deflections(list(message.axes), list(message.buttons), stamp, "spacenav/joy")

    def _on_twist(self, message: Twist) -> None:
        """Take deflections without buttons, unless the driver sends them with buttons, too."""
        if self._has_joy:
            return
        v, w = message.linear, message.angular
        axes = [v.x, v.y, v.z, w.x, w.y, w.z]
        self._take_deflections(axes, [], self._device.read_clock(), "spacenav/twist")

    def _take_deflections(
        self, axes: list[float], buttons: list[int], stamp: int, topic: str
    ) -> None:
        measurement = self._mouse.move_probe(axes, buttons, stamp)
        if measurement is not None:
            self._device.take_measurement(measurement)
        elif self._mouse.last_problem:
            self._device.refuse_measurement("axes", f"{topic}: {self._mouse.last_problem}")


MOVING = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Many nodes share `tf`: the newest message alone would often be another node's."""
STATIC = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STALE_S = 2.0  # by which a link of the chain may be older than another; some are stamped ahead


class TfInput(TrackerInput):
    """The frame ``tracker.body`` in the frame ``tracker.frame``, each time that all between moved.

    Its stamp is the latest time of which all frames between are known, see `FrameChain`.
    """

    def __init__(self, device: TrackerNode, settings: Any) -> None:
        super().__init__(device, settings)
        if TFMessage is None:
            raise TrackingError(
                "tracker source `tf`: tf2_msgs is not installed, and PyPI does not have it: use a "
                "ROS 2 installation, or publish geometry_msgs/PoseStamped on tracker/pose"
            )
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
        self._chain = FrameChain(self._body, self._frame)
        device.subscribe(TFMessage, "tf", self._on_tf, MOVING)
        device.subscribe(TFMessage, "tf_static", self._on_static, STATIC)

    def reset(self) -> None:
        """Forget what moved; what is fixed is sent only once."""
        self._chain.forget_motion()

    def _on_static(self, message: TFMessage) -> None:
        """Keep static transforms; refuse a chain of these alone."""
        for child, parent, pose, _ in self._transforms(message):
            self._chain.set_fixed_link(child, parent, pose)
        if self._chain.is_fixed:
            self._device.refuse_measurement(
                "frame",
                f"nothing moves in tf between '{self._frame}' and '{self._body}': all of it is in "
                f"tf_static, so no pose comes",
            )

    def _transforms(self, message: TFMessage) -> Iterator[tuple[str, str, Pose, Header]]:
        """Yield child, parent, pose and header of each transform that is a pose."""
        for transform in message.transforms:
            child = transform.child_frame_id.lstrip("/")
            parent = transform.header.frame_id.lstrip("/")
            try:
                yield child, parent, transform_from(transform), transform.header
            except PoseError as error:
                self._device.refuse_measurement(
                    "pose", f"tf from {parent} to {child}: {error}; it is not used"
                )

    def _on_tf(self, message: TFMessage) -> None:
        for child, parent, pose, header in self._transforms(message):
            stamp = self._device.stamp_of(header, "tf")
            made = self._chain.update_link(child, parent, stamp, pose)
            if made is not None:
                self._device.take_measurement(Measurement(*made))
        if self._chain.find_links() is None:
            self._device.refuse_measurement(
                "frame",
                f"tf has no way from '{self._body}' up to '{self._frame}' yet: see tracker.body "
                f"and tracker.frame in the scene",
            )
            return
        link, lag = self._chain.find_slowest_link()
        if lag > STALE_S:
            self._device.refuse_measurement(
                "time",
                f"the newest transform of '{link}' in tf is {lag:.1f} s older than others on the "
                f"way to '{self._frame}', and a pose needs all at one time: publish it as often as "
                f"it moves, or in tf_static",
            )
