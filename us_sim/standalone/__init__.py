"""ROS 2's Python interface where ROS 2 is not installed: `rclpy` and message packages over DDS."""

import importlib.util
import sys


def install() -> bool:
    """Make `rclpy` and message packages importable, unless the real rclpy is there.

    Returns:
        True when what can be imported is this package's subset.
    """
    from .alias import AliasFinder

    if any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        return True
    if "rclpy" in sys.modules or importlib.util.find_spec("rclpy") is not None:
        return False
    from .messages import register_message_modules

    # First, since otherwise the files would be found once more, as other modules.
    sys.meta_path.insert(0, AliasFinder("rclpy", f"{__name__}.rclpy"))
    register_message_modules()
    return True
