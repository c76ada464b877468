"""Moves a colour box or a gate with a vessel, by the parameters that say where it is."""

from __future__ import annotations

from rclpy.parameter import Parameter

from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import nearest_vessel
from us_sim.slicing.frame import Frame
from us_sim.slicing.settings import DopplerSettings

EVERY_S = 0.2
"""Between two looks at where the vessel is; of the frames' time."""


class Following:
    """Keeps ``PREFIX.lateral`` and ``PREFIX.depth`` on a vessel where ``PREFIX.follow`` is set.

    Args:
        node: whose parameters they are.
        prefix: of them, with its dot.
        blood: in the vessels.
    """

    def __init__(self, node: SceneNode, prefix: str, blood: Blood) -> None:
        self._node, self._prefix, self._blood = node, prefix, blood
        self._looked = 0.0  # s, of the frame's time

    def look(self, frame: Frame, settings: DopplerSettings, steering: float) -> None:
        """Move it, for the frames to come; ``steering`` (rad) is that of beams from the face on."""
        if not settings.follow or 0.0 <= frame.time - self._looked < EVERY_S:
            return
        self._looked = frame.time
        depth = 0.5 * frame.probe.depth if settings.depth is None else settings.depth
        place = nearest_vessel(self._blood, frame, settings.lateral, depth, steering)
        if place is None:
            return
        for name, value in zip(("lateral", "depth"), place, strict=True):
            self._node.set_parameters([Parameter(f"{self._prefix}{name}", value=value)])
