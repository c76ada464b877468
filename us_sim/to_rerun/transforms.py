"""Frames: each transform of tf, between the frames that it names."""

from __future__ import annotations

from typing import Any

import rerun

from us_sim.nodes.conversions import transform_from
from us_sim.to_rerun.rerun_file import RerunFile


class Transforms:
    """``tf2_msgs/TFMessage``."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log where each child is in its parent."""
        for each in message.transforms:
            pose, child = transform_from(each), each.child_frame_id
            file.log(
                f"{entity}/{child}",
                rerun.Transform3D(
                    translation=pose.position,
                    quaternion=pose.orientation,
                    parent_frame=each.header.frame_id,
                    child_frame=child,
                ),
            )
