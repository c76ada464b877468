"""A topic of images made from frames; B-mode, labels, displacement and M-mode as such."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.messages import colour_image_message, field_message, image_message
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.compressed import Compressed
from us_sim.settings.setting import Settings
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.m_mode import MMode
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import MModeSettings
from us_sim.slicing.strain import displacement


class FrameStream(ABC):
    """One topic of images, made from each frame while somebody subscribes.

    A part that has parameters declares them when it is made. What is costly is taken from the
    frame, where others find it, too.

    Args:
        node: that publishes it.
    """

    topic: ClassVar[str]  # its name

    def __init__(self, node: SceneNode) -> None:
        self._node = node
        self._publisher = node.stream(Image, self.topic)

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
        message = self._message(frame, stamp)
        if message is not None:
            self._publisher.publish(message)
            self._node.health.published(self.topic)

    @abstractmethod
    def _message(self, frame: Frame, stamp: Time) -> Image | None:
        """The message of a frame; None where there is none."""

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
        settings: the parameters by default.
        prefix: before their names.
    """

    def __init__(self, node: SceneNode, settings: Settings, prefix: str) -> None:
        super().__init__(node)
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

    @abstractmethod
    def _make(self, probe: Probe, settings: Any) -> M:
        """The object that makes the topic.

        Raises:
            ProbeError: what is set lies outside the images of this probe.
        """

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


class BModeStream(FrameStream):
    """``ultrasound/image``, whose age counts as the node's latency, and its companion."""

    topic = "ultrasound/image"

    def __init__(self, node: SceneNode) -> None:
        self._compressed = Compressed(node, self.topic)
        super().__init__(node)

    @property
    def is_wanted(self) -> bool:
        """Whether somebody subscribes to one of both."""
        return super().is_wanted or self._compressed.is_wanted

    def show(self, frame: Frame, stamp: Time) -> None:
        """Send the picture, under the stamp of its pose."""
        message = self._message(frame, stamp)
        self._publisher.publish(message)
        self._node.health.published(self.topic, stamp)
        self._compressed.send(message)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return image_message(frame.pixels, stamp, "probe")


class LabelStream(FrameStream):
    """``ultrasound/labels``: the number of the volume's label at each pixel, 0 for nothing."""

    topic = "ultrasound/labels"

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return image_message(frame.labels, stamp, "probe")


class DisplacementStream(FrameStream):
    """``ultrasound/displacement``: lateral and axial, m, of each pixel's tissue since rest."""

    topic = "ultrasound/displacement"

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return field_message(displacement(frame), stamp, "probe")


class MModeStream(SettableStream[MMode]):
    """``ultrasound/m_mode``: the image along a line over time; parameters ``m_mode.…``."""

    topic = "ultrasound/m_mode"

    def __init__(self, node: SceneNode) -> None:
        super().__init__(node, node.scene.m_mode, "m_mode.")

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """The line in the image."""
        return [self._made.places] if self._made else ()

    def _make(self, probe: Probe, settings: MModeSettings) -> MMode:
        return MMode(probe, settings)

    def _go_on(self, made: MMode, before: MMode) -> None:
        made.go_on(before)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        picture = self.for_frame(frame).show(frame.pixels, frame.time)
        return colour_image_message(picture, stamp, "probe")
