"""Messages of tf, where ``tf2_msgs`` is installed: every ROS 2 has it, PyPI has not."""

from __future__ import annotations

import contextlib
from typing import Any

__all__ = ["TFMessage"]

TFMessage: Any = None
"""The class of tf2_msgs; None where it is not installed."""

with contextlib.suppress(ModuleNotFoundError):
    from tf2_msgs.msg import TFMessage  # type: ignore[no-redef]
