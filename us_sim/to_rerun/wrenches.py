"""Forces: an arrow where they act, and three curves."""

from __future__ import annotations

from typing import Any

import rerun

from us_sim.nodes.conversions import wrench_from
from us_sim.to_rerun.rerun_file import RerunFile

FORCE = "force"
"""What a topic's name is followed by in the entity of the curves."""
METRES_A_NEWTON = 0.002
"""Of the arrow's length."""
_RADIUS = 0.0008
"""m, of the arrow's shaft."""
_AXES = ("x", "y", "z")
_COLOURS = ((224, 108, 117), (152, 195, 121), (97, 175, 239))


class Wrenches:
    """``geometry_msgs/WrenchStamped``."""

    def __init__(self) -> None:
        self._named: set[str] = set()

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log the force at the origin of its frame."""
        force = wrench_from(message)[:3]
        file.place(entity, message.header.frame_id)
        arrow = METRES_A_NEWTON * force
        file.log(entity, rerun.Arrows3D(vectors=arrow, radii=_RADIUS, colors=(255, 255, 255)))
        curves = f"{entity}/{FORCE}"
        if curves not in self._named:
            self._named.add(curves)
            names = [f"{axis}, N" for axis in _AXES]
            file.log(curves, rerun.SeriesLines(names=names, colors=_COLOURS), static=True)
        file.log(curves, rerun.Scalars(force))
