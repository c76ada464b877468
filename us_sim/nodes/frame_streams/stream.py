"""What topics that are made from frames have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe


class FrameStream(ABC):
    """One topic of images, made from each frame while somebody subscribes.

    A part that has parameters declares them when it is made. What is costly is taken from the
    frame, where others find it, too.

    Args:
        node: that publishes it.
    """

    topic: ClassVar[str]
    """Its name."""
    overlay_name: ClassVar[str] = ""
    """What chooses it as the colours over the annotated image; empty where it has none."""

    def __init__(self, node: SceneNode) -> None:
        self._node = node
        self._publisher = node.stream(Image, self.topic)

    @property
    def is_wanted(self) -> bool:
        """Whether somebody subscribes."""
        return bool(self._publisher.get_subscription_count() > 0)

    def prepare(self, probe: Probe) -> None:
        """Load what images of this probe will use, so that the first is not late.

        Raises:
            UsSimError: it cannot be used with this probe.
        """
        del probe

    def show(self, frame: Frame, stamp: Time) -> None:
        """Send what is made of the frame, under the stamp of its pose."""
        message = self._message(frame, stamp)
        if message is not None:
            self._publisher.publish(message)
            self._node.health.published(self.topic)

    @abstractmethod
    def _message(self, frame: Frame, stamp: Time) -> Image | None:
        """What is sent of a frame; None where it has nothing to send."""

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """Lines (N, 2), column and row, that show in the annotated image where it looks."""
        return ()

    def overlay(self, frame: Frame) -> Overlay | None:
        """The colours that it lays over the frame's picture; None where it has none."""
        del frame
        return None
