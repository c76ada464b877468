"""Messages of tf, where ``tf2_msgs`` is installed: every ROS 2 has it, PyPI has not."""

from __future__ import annotations

import contextlib
from typing import Any

from us_sim.errors import TrackingError

TFMessage: Any = None
"""The class of tf2_msgs; None where it is not installed."""

with contextlib.suppress(ModuleNotFoundError):
    from tf2_msgs.msg import TFMessage  # type: ignore[no-redef]


def require_tf() -> None:
    """Raise TrackingError where poses cannot be taken from tf."""
    if TFMessage is None:
        raise TrackingError(
            "tracker source `tf`: tf2_msgs is not installed, and PyPI does not have it: use a "
            "ROS 2 installation, or publish geometry_msgs/PoseStamped on tracker/pose"
        )
