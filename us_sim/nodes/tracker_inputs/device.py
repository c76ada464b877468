"""A source of poses, and the part of the probe tracker that it uses."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from us_sim.errors import PoseError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import kind_of
from us_sim.nodes.process import MEASURING
from us_sim.nodes.qos import EVERY, FOREIGN
from us_sim.nodes.scene_node import SceneNode
from us_sim.recording.decoding import nanoseconds_of, pose_from
from us_sim.settings.setting import Settings
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.probe_tracking import ProbeTracking


class TrackerInput:
    """Hands the measurements of one kind of source to the tracker, with `Device.take`.

    A source of poses is a subclass of this, registered in `us_sim.settings.registry.TRACKERS` or,
    by another package, under the entry point group ``us_sim.trackers``.

    Args:
        device: the tracker, as far as inputs need it.
        settings: an instance of ``Settings``, from the scene.
    """

    Settings: ClassVar[type[Settings]] = Settings
    """Settings of this source in a scene, under its own name in ``tracker``."""

    def __init__(self, device: Device, settings: Any) -> None:
        self._device = device
        self._settings = settings

    def reset(self) -> None:
        """Forget all measurements, since taking a message has failed."""

    def close(self) -> None:
        """Let go of the device, where it is held by more than subscriptions."""


class Device(SceneNode):
    """The tracker as its input uses it: where measurements go, and how messages are got."""

    live_priority = MEASURING

    _input: TrackerInput
    _tracking: ProbeTracking

    @abstractmethod
    def take(self, measurement: Measurement) -> None:
        """Publish the probe's pose, if the measurement can be believed."""

    def refuse(self, kind: str, sentence: str) -> None:
        """Count and say, now and then, why a measurement is not used."""
        self._tracking.refuse(kind, sentence)
        self.health.problem(kind, sentence)

    def refused(self, where: str, error: UsSimError) -> None:
        """Count and report bad input, in the probe's status too."""
        self._tracking.refuse(kind_of(error), str(error))
        super().refused(where, error)

    def pose_in(self, message: PoseStamped, topic: str, frame: str | None = None) -> Pose | None:
        """The pose in a message, if it is one and in a frame, the scene's; said when not."""
        header, frame = message.header, frame or self.scene.tracker.frame
        name = self.resolve_topic_name(topic)
        if header.frame_id != frame:
            self.refuse(
                "frame",
                f"{name} is in frame '{header.frame_id}', not '{frame}': set the tracker's frame, "
                f"or tracker.frame in the scene",
            )
            return None
        try:
            pose = pose_from(message)
        except PoseError as error:
            self.refuse("pose", f"{name}: {error}; it is not used")
            return None
        q = message.pose.orientation
        length = math.hypot(q.x, q.y, q.z, q.w)
        if abs(length - 1.0) > 1e-2:  # more than rounding
            self.health.problem(
                "quaternion", f"{topic}: the quaternion's length is {length:.4g}, taken as 1"
            )
        return pose

    def stamp_of(self, header: Header, topic: str) -> int:
        """When a message was measured, ns; its arrival where it does not say.

        Raises:
            StampError: the stamp is no time; raised on, the message is refused.
        """
        stamp = nanoseconds_of(header.stamp)
        if stamp == 0:
            name = self.resolve_topic_name(topic)
            self.health.problem("stamp", f"{name} has no stamp: its time of arrival is used")
            stamp = self.now()
        return stamp

    def now(self) -> int:
        """The present, ns."""
        return int(self.get_clock().now().nanoseconds)

    def listen_to_device(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        quality: QoSProfile | None = None,
    ) -> None:
        """Subscribe as drivers may publish, best effort; all that come count as received."""
        work = self._of_source(callback)

        def count(message: Any) -> None:
            self.health.received += 1
            work(message)

        self.listen(message_type, topic, count, EVERY if self.lockstep else quality or FOREIGN)

    def listen_to_newest(self, message_type: Any, topic: str, work: Callable[[Any], None]) -> None:
        """Likewise, but ``work`` gets the newest alone where it is slower than messages come."""
        qos = EVERY if self.lockstep else FOREIGN
        self.newest(message_type, topic, self._of_source(work), qos)

    def in_tracker(self, work: Callable[[], None]) -> Callable[[], None]:
        """A function that another thread calls to have ``work`` done in the tracker's own."""
        return functools.partial(self.call_soon, self._of_source(work))

    def every(self, seconds: float, work: Callable[[], None]) -> Any:
        """A timer, which has ``cancel``."""
        return self.create_timer(seconds, self._of_source(work))

    def _of_source(self, work: Callable[..., None]) -> Callable[..., None]:
        """The source's ``work``; should it fail, the source is reset, for it may be of no use."""

        @functools.wraps(work)
        def call(*arguments: Any) -> None:
            try:
                work(*arguments)
            except UsSimError:
                raise
            except Exception:
                self._input.reset()
                self._tracking.reset()
                raise

        return call

    def is_awaited(self) -> bool:
        """Whether the simulation's other nodes are there and listen to the probe."""
        return bool(self.count_subscribers("probe/pose")) and all(
            self.count_publishers(topic) for topic in self.scene.ready_topics
        )

    def say(self, sentence: str) -> None:
        """Tell a person."""
        self.get_logger().info(sentence)

    def warn(self, sentence: str) -> None:
        """Tell a person that something is amiss."""
        self.get_logger().warning(sentence)
