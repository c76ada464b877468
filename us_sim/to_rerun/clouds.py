"""Points of clouds, such as the tissue's nodes."""

from __future__ import annotations

from typing import Any

import rerun

from us_sim.nodes.conversions import vectors_from
from us_sim.to_rerun.rerun_file import RerunFile

_RADIUS = rerun.Radius.ui_points(1.5)
_COLOUR = (79, 179, 191)


class Clouds:
    """``sensor_msgs/PointCloud2``, as points that are as large from afar."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log where the points are."""
        file.place(entity, message.header.frame_id)
        file.log(entity, rerun.Points3D(vectors_from(message), radii=_RADIUS, colors=_COLOUR))
