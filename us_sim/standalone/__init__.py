"""ROS 2's Python interface where ROS 2 is not installed: `rclpy`, messages, DDS or zenoh."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# Modules of rclpy that are parts of another one here.
_PARTS = {
    "_rclpy_pybind11": "exceptions",
    "callback_groups": "endpoints",
    "client": "endpoints",
    "clock": "time",
    "clock_type": "time",
    "constants": "time",
    "duration": "time",
    "guard_condition": "endpoints",
    "impl.logging_severity": "logging",
    "impl.rcutils_logger": "logging",
    "parameter_client": "parameter",
    "parameter_service": "parameter",
    "publisher": "endpoints",
    "qos_overriding_options": "qos",
    "serialization": "endpoints",
    "service": "endpoints",
    "signals": "context",
    "subscription": "endpoints",
    "time_source": "node",
    "timer": "endpoints",
    "topic_endpoint_info": "node",
    "utilities": "context",
}


def install() -> bool:
    """Make `rclpy` and message packages importable, unless the real rclpy is there.

    Returns:
        True when `rclpy` is this package's subset.
    """
    if any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        return True
    if "rclpy" in sys.modules or importlib.util.find_spec("rclpy") is not None:
        return False
    from .messages import register_message_modules

    # First, since otherwise the files would be found once more, as other modules.
    sys.meta_path.insert(0, AliasFinder("rclpy", f"{__name__}.rclpy", _PARTS))
    register_message_modules()
    return True


class AliasFinder(MetaPathFinder, Loader):
    """Imports `alias.x` as the module `target.x`, or `target.parts[x]` where there is one.

    >>> import sys
    >>> sys.meta_path.insert(0, AliasFinder("shapes", "collections", {"shape": "abc"}))
    >>> import shapes.abc, shapes.shape, collections.abc
    >>> shapes.abc is shapes.shape is collections.abc
    True
    """

    def __init__(self, alias: str, target: str, parts: Mapping[str, str]) -> None:
        self._alias, self._target, self._parts = alias, target, parts
        self._true_specs: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        if fullname != self._alias and not fullname.startswith(f"{self._alias}."):
            return None
        original = importlib.util.find_spec(self._original(fullname))
        if original is None:
            return None
        is_package = original.submodule_search_locations is not None
        return ModuleSpec(fullname, self, origin=original.origin, is_package=is_package)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._original(spec.name))
        self._true_specs[module.__name__] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system has just given the module the alias's spec; relative imports inside it
        # need its own.
        module.__spec__ = self._true_specs.pop(module.__name__)

    def _original(self, name: str) -> str:
        part = name[len(self._alias) + 1 :]
        part = self._parts.get(part, part)
        return f"{self._target}.{part}" if part else self._target
