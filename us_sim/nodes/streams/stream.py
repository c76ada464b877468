"""A topic of images made from frames, also by what a person sets while it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.messages import image_message
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.settings.setting import Settings
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.m_mode import MMode
from us_sim.slicing.probe.probe import Probe

IMAGE = "ultrasound/image"
"""The topic whose age counts as the node's latency."""

Draw = Callable[[Frame], "NDArray[Any] | None"]
"""The pixels of a frame, as `image_message` takes them; None where there are none."""


class FrameStream:
    """One topic of images, made from each frame while somebody subscribes.

    A part that has parameters declares them when it is made. What is costly is taken from the
    frame, where others find it, too.

    Args:
        node: that publishes it.
        topic: its name.
        draw: the pixels of a frame.
    """

    def __init__(self, node: SceneNode, topic: str, draw: Draw) -> None:
        self._node, self.topic, self._draw = node, topic, draw
        self._publisher = node.stream(Image, topic)

    @property
    def is_wanted(self) -> bool:
        """Whether somebody subscribes."""
        return bool(self._publisher.get_subscription_count() > 0)

    def prepare(self, probe: Probe) -> None:
        """Load everything for images of this probe, so that the first is not late.

        Raises:
            UsSimError: it cannot be used with this probe.
        """
        del probe

    def show(self, frame: Frame, stamp: Time) -> None:
        """Send the image made of the frame, under the stamp of its pose."""
        pixels = self._draw(frame)
        if pixels is not None:
            self._publisher.publish(image_message(pixels, stamp, "probe"))
            self._node.health.published(self.topic, stamp if self.topic == IMAGE else None)

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """Lines (N, 2), column and row, that show in the annotated image where it looks."""
        return ()

    def overlay(self, frame: Frame) -> Overlay | None:
        """The colours that it lays over the frame's picture; None where it has none."""
        del frame
        return None


M = TypeVar("M")


class SettableStream(FrameStream, Generic[M]):
    """A topic made by an object for one probe and one state of its parameters.

    Args:
        node: that publishes it.
        topic: its name.
        draw: the pixels of a frame, by the object that `for_frame` returns.
        make: makes the object; a ProbeError refuses what is set.
        settings: the parameters by default.
        prefix: before their names.
    """

    def __init__(
        self,
        node: SceneNode,
        topic: str,
        draw: Draw,
        make: Callable[[Probe, Any], M],
        settings: Settings,
        prefix: str,
    ) -> None:
        super().__init__(node, topic, draw)
        self._make = make
        self._made: M | None = None
        self._is_outdated = False  # by a parameter that was set
        self._probe: Probe | None = None
        self._settings = LiveSettings(
            node, {"set": Group(settings, prefix)}, self._require, self._forget
        )

    def prepare(self, probe: Probe) -> None:
        """Check whether it can be made for this probe; the one in use stays.

        Raises:
            ProbeError: what is set lies outside the images of this probe.
        """
        made = self._make(probe, self._settings.values["set"])
        if self._probe is None:
            self._probe, self._made = probe, made

    def for_frame(self, frame: Frame) -> M:
        """The object that makes the topic of this frame."""
        if self._made is None or self._is_outdated or frame.probe is not self._probe:
            made, before = self._make(frame.probe, self._settings.values["set"]), self._made
            if before is not None:
                self._go_on(made, before)
            self._probe, self._made, self._is_outdated = frame.probe, made, False
        return self._made

    def _go_on(self, made: M, before: M) -> None:
        """Take over the state of the topic's former maker that still holds."""
        del made, before

    def _require(self, wanted: dict[str, Any]) -> None:
        if self._probe is not None:
            self._make(self._probe, wanted["set"])

    def _forget(self, _: dict[str, Any]) -> None:
        self._is_outdated = True


class MModeStream(SettableStream[MMode]):
    """``ultrasound/m_mode``: the image along a line over time; parameters ``m_mode.…``."""

    def __init__(self, node: SceneNode) -> None:
        super().__init__(
            *(node, "ultrasound/m_mode", self._strip, MMode, node.scene.m_mode, "m_mode.")
        )

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """The line in the image."""
        return [self._made.places] if self._made else ()

    def _go_on(self, made: MMode, before: MMode) -> None:
        made.go_on(before)

    def _strip(self, frame: Frame) -> NDArray[np.uint8]:
        return self.for_frame(frame).show(frame.pixels, frame.time)
