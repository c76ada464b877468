"""The default context, and small questions about this process."""

import sys
import threading
from collections.abc import Sequence

from ._arguments import parse_arguments
from .context import Context

_default_context: Context | None = None
_lock = threading.RLock()


def get_default_context(*, shutting_down: bool = False) -> Context:
    """The context that is used where none is given; forgotten when it is shutting down."""
    global _default_context
    with _lock:
        context = Context() if _default_context is None else _default_context
        _default_context = None if shutting_down else context
        return context


def ok(*, context: Context | None = None) -> bool:
    """Whether a context was initialised and not yet shut down."""
    return (get_default_context() if context is None else context).ok()


def shutdown(*, context: Context | None = None) -> None:
    """Shut a context down; raises when it is not up."""
    (get_default_context(shutting_down=True) if context is None else context).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Shut a context down if it is up."""
    (get_default_context(shutting_down=True) if context is None else context).try_shutdown()


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """A command line (`sys.argv` when None) without what is between --ros-args and --."""
    return list(parse_arguments(sys.argv if args is None else args).others)


def get_rmw_implementation_identifier() -> str:
    """Which middleware this speaks: the mapping of ROS onto DDS is Cyclone's."""
    return "rmw_cyclonedds_cpp"
