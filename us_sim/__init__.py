"""Interactive simulation of compression ultrasonography as a ROS 2 node graph."""

from collections.abc import Callable

__version__ = "0.1.0"
Progress = Callable[[float, str], None]
"""Called with the fraction done of what takes long, and what is being done."""
