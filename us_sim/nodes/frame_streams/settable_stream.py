"""What topics have in common that a sonographer sets while they are made."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Generic, TypeVar

from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.settings.setting import Settings
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe

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
        """See whether it can be made for this probe; what is in use stays.

        Raises:
            ProbeError: what is set lies outside the images of this probe.
        """
        made = self._make(probe, self._settings.values["set"])
        if self._probe is None:
            self._probe, self._made = probe, made

    @abstractmethod
    def _make(self, probe: Probe, settings: Any) -> M:
        """What makes the topic.

        Raises:
            ProbeError: what is set lies outside the images of this probe.
        """

    def for_frame(self, frame: Frame) -> M:
        """What makes the topic of this frame."""
        if self._made is None or self._is_outdated or frame.probe is not self._probe:
            made, before = self._make(frame.probe, self._settings.values["set"]), self._made
            if before is not None:
                self._go_on(made, before)
            self._probe, self._made, self._is_outdated = frame.probe, made, False
        return self._made

    def _go_on(self, made: M, before: M) -> None:
        """Take over, from what made the topic before, what still holds."""
        del made, before

    def _require(self, wanted: dict[str, Any]) -> None:
        if self._probe is not None:
            self._make(self._probe, wanted["set"])

    def _forget(self, _: dict[str, Any]) -> None:
        self._is_outdated = True
