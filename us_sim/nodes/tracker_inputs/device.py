"""What an input of the probe tracker can ask of the tracker, and what it must be itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from us_sim.settings.setting import Settings

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import QoSProfile
    from std_msgs.msg import Header

    from us_sim.geometry.pose import Pose
    from us_sim.nodes.guarded_node import Health
    from us_sim.scene.scene import Scene
    from us_sim.tracking.measurement import Measurement


class TrackerInput:
    """Hands the measurements of one kind of source to the tracker, with `Device.take`.

    A source of poses is a subclass of this, registered in `us_sim.settings.registry.TRACKERS` or,
    by another package, under the entry point group ``us_sim.trackers``.

    Args:
        device: the tracker, as far as inputs need it.
        settings: an instance of ``Settings``, from the scene.
    """

    Settings: ClassVar[type[Settings]] = Settings
    """What a scene can say of this source, under the source's own name in ``tracker``."""

    def __init__(self, device: Device, settings: Any) -> None:
        self._device = device
        self._settings = settings

    def reset(self) -> None:
        """Forget what was measured: it may be of no use, since taking a message has failed."""

    def close(self) -> None:
        """Let go of the device, where it is held by more than subscriptions."""


class Device(Protocol):
    """The tracker as its input sees it: where measurements go, and how messages are got."""

    scene: Scene
    lockstep: bool  # every message is worked on, and none is dropped
    health: Health

    def take(self, measurement: Measurement) -> None:
        """Publish the probe's pose, if the measurement can be believed."""

    def refuse(self, kind: str, sentence: str) -> None:
        """Count and say, now and then, why a measurement is not used."""

    def pose_in(self, message: PoseStamped, topic: str, frame: str | None = None) -> Pose | None:
        """The pose in a message, if it is one and in a frame, the scene's; said when not."""

    def stamp_of(self, header: Header, topic: str) -> int:
        """When a message was measured, ns; its arrival where it does not say.

        Raises:
            StampError: the stamp is no time; raised on, the message is refused.
        """

    def now(self) -> int:
        """The present, ns."""

    def listen_to_device(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        quality: QoSProfile | None = None,
    ) -> None:
        """Subscribe as drivers may publish, best effort; all that come count as received."""

    def listen_to_newest(self, message_type: Any, topic: str, work: Callable[[Any], None]) -> None:
        """Likewise, but ``work`` gets the newest alone where it is slower than messages come."""

    def listen(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile | None = None,
    ) -> None:
        """Subscribe with a quality of service of one's own."""

    def in_tracker(self, work: Callable[[], None]) -> Callable[[], None]:
        """What another thread calls to have ``work`` done in the tracker's own."""

    def is_awaited(self) -> bool:
        """Whether the simulation's other nodes are there and listen to the probe."""

    def every(self, seconds: float, work: Callable[[], None]) -> Any:
        """A timer, which has ``cancel``."""

    def say(self, sentence: str) -> None:
        """Tell a person."""

    def warn(self, sentence: str) -> None:
        """Tell a person that something is amiss."""
