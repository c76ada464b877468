"""A topic of images made from frames, by parameters that may change while it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.messages import image_message
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.settings.setting import Settings
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.m_mode import MMode
from us_sim.slicing.probe.probe import Probe

IMAGE = "ultrasound/image"  # the topic whose age is the node's latency


class FrameStream:
    """One topic of images, made from each frame while somebody subscribes.

    Args:
        node: that publishes it.
        topic: its name.
        draw: returns the pixels of a frame, as `image_message` takes them, or None.
        prepare: loads everything for images of a probe, so that the first is not late; it raises a
            UsSimError if they cannot be made with that probe.
        overlay: returns colours over the frame's picture, or None.
        lines: returns lines (N, 2), column and row, that show its place in the annotated image.
    """

    def __init__(
        self,
        node: SceneNode,
        topic: str,
        draw: Callable[[Frame], NDArray[Any] | None],
        *,
        prepare: Callable[[Probe], None] = lambda _: None,
        overlay: Callable[[Frame], Overlay | None] = lambda _: None,
        lines: Callable[[], Sequence[NDArray[Any]]] = tuple,
    ) -> None:
        self.topic, self.prepare, self.overlay, self.lines = topic, prepare, overlay, lines
        self._node, self._draw = node, draw
        self._publisher = node.create_stream_publisher(Image, topic)

    @property
    def is_wanted(self) -> bool:
        """True if somebody subscribes."""
        return bool(self._publisher.get_subscription_count() > 0)

    def publish_frame(self, frame: Frame, stamp: Time) -> None:
        """Send the image made of the frame, under the stamp of its pose."""
        pixels = self._draw(frame)
        if pixels is not None:
            self._publisher.publish(image_message(pixels, stamp, "probe"))
            self._node.health.count_published(self.topic, stamp if self.topic == IMAGE else None)


M = TypeVar("M")


class AdjustableImager(Generic[M]):
    """The object that makes a topic's images, made anew for another probe or other parameters.

    Args:
        node: that has the parameters.
        make: makes the object; a ProbeError refuses parameters.
        settings: the parameters by default.
        prefix: before their names.
        go_on: has a new object take over what is still valid of the one before.
    """

    def __init__(
        self,
        node: SceneNode,
        make: Callable[[Probe, Any], M],
        settings: Settings,
        prefix: str,
        go_on: Callable[[M, M], None] = lambda *_: None,
    ) -> None:
        self._make, self._go_on = make, go_on
        self.made: M | None = None
        self._made_for: tuple[Probe, Settings] | None = None
        self._prefix = prefix
        self._settings = LiveSettings(node, {prefix: settings}, self._require)

    def prepare_for_probe(self, probe: Probe) -> None:
        """Make it for this probe if none is in use, else only check that this is possible."""
        wanted = probe, self._settings.values[self._prefix]
        made = self._make(*wanted)
        if self._made_for is None:
            self.made, self._made_for = made, wanted

    def for_frame(self, frame: Frame) -> M:
        """Return the object for this frame."""
        wanted = frame.probe, self._settings.values[self._prefix]
        if self.made is None or wanted != self._made_for:
            made, before = self._make(*wanted), self.made
            if before is not None:
                self._go_on(made, before)
            self.made, self._made_for = made, wanted
        return self.made

    def _require(self, wanted: dict[str, Any]) -> None:
        if self._made_for is not None:
            self._make(self._made_for[0], wanted[self._prefix])


def create_m_mode_stream(node: SceneNode) -> FrameStream:
    """Create ``ultrasound/m_mode``: the image along a line over time, by ``m_mode.…``."""
    m_mode = AdjustableImager(node, MMode, node.scene.m_mode, "m_mode.", MMode.take_over_picture)
    return FrameStream(
        *(node, "ultrasound/m_mode"),
        lambda frame: m_mode.for_frame(frame).draw_sweep(frame.pixels, frame.time),
        prepare=m_mode.prepare_for_probe,
        lines=lambda: [m_mode.made.places] if m_mode.made else [],
    )
