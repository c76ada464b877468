"""A source of poses, and the tracker's node as a source uses it."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, ClassVar

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from us_sim.errors import FrameError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import error_kind
from us_sim.nodes.process import MEASURING
from us_sim.nodes.scene_node import SceneNode
from us_sim.recording.decoding import nanoseconds_of, pose_from
from us_sim.settings.setting import Settings
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.probe_tracking import ProbeTracking


class TrackerInput:
    """A source of poses, which hands its measurements to `TrackerNode.take_measurement`.

    Its subclasses are registered in `us_sim.settings.registry.TRACKERS` or, by another package,
    under the entry point group ``us_sim.trackers``.

    Args:
        device: the tracker's node.
        settings: an instance of ``Settings``, from the scene.
    """

    Settings: ClassVar[type[Settings]] = Settings
    """Settings of this source in a scene, under its own name in ``tracker``."""

    def __init__(self, device: TrackerNode, settings: Any) -> None:
        self._device = device
        self._settings = settings

    def reset(self) -> None:
        """Forget all measurements, since a callback has failed."""

    def close(self) -> None:
        """Close the device, if there are more than subscriptions."""


class TrackerNode(SceneNode):
    """The tracker's node, as sources use it."""

    live_priority = MEASURING

    _input: TrackerInput
    _tracking: ProbeTracking

    @abstractmethod
    def take_measurement(self, measurement: Measurement) -> None:
        """Publish the probe's pose, unless the measurement is refused."""

    def refuse_measurement(self, kind: str, sentence: str) -> None:
        """Count and log a measurement that is not used, with the reason."""
        self._tracking.count_refusal(kind, sentence)
        self.health.count_problem(kind, sentence)

    def report_bad_input(self, where: str, error: UsSimError) -> None:
        """Count and report bad input, in the probe's status too."""
        self._tracking.count_refusal(error_kind(error), str(error))
        super().report_bad_input(where, error)

    def report_failure(self, where: str, error: Exception) -> None:
        """Count and log a failure, and begin anew, since the failed state may be corrupt."""
        super().report_failure(where, error)
        self._input.reset()
        self._tracking.reset()

    def read_measurement(
        self, message: PoseStamped, topic: str, frame: str = ""
    ) -> tuple[int, Pose]:
        """Return a message's stamp, ns, and its pose in ``frame``, by default the scene's.

        Raises:
            FrameError: it is in another frame.
            PoseError: it is no pose.
            StampError: its stamp is no time.
        """
        found, frame = message.header.frame_id, frame or self.scene.tracker.frame
        if found != frame:
            raise FrameError(
                f"is in frame '{found}', not '{frame}': set the tracker's frame, or tracker.frame "
                f"in the scene"
            )
        pose = pose_from(message)
        q = message.pose.orientation
        length = math.hypot(q.x, q.y, q.z, q.w)
        if abs(length - 1.0) > 1e-2:  # more than rounding
            self.health.count_problem(
                "quaternion", f"{topic}: the quaternion's length is {length:.4g}, taken as 1"
            )
        return self.stamp_of(message.header, topic), pose

    def stamp_of(self, header: Header, topic: str) -> int:
        """Return the time of measurement, ns: a message's stamp, or now if it has none."""
        stamp = nanoseconds_of(header.stamp)
        if stamp == 0:
            self.health.count_problem("stamp", f"{topic} has no stamp: its time of arrival is used")
            stamp = self.read_clock()
        return stamp

    def read_clock(self) -> int:
        """Return the present time, ns."""
        return int(self.get_clock().now().nanoseconds)
