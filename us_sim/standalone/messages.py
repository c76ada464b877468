"""ROS 2's messages and services without ROS 2: classes, bytes, type hashes and modules.

>>> from us_sim.standalone.messages import message_class, register_message_modules, serialize
>>> Clock = message_class("rosgraph_msgs/msg/Clock")
>>> serialize(Clock()).hex()
'000100000000000000000000'
>>> register_message_modules()  # doctest: +SKIP
>>> from geometry_msgs.msg import PoseStamped  # doctest: +SKIP
"""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from types import ModuleType
from typing import Any, ClassVar

from .cdr import CdrError, deserialize, serialize
from .interfaces import (
    InterfaceError,
    interface,
    message_names,
    packages,
    service_names,
    type_hash,
)
from .message_class import Message, message_class

__all__ = [
    "CdrError",
    "InterfaceError",
    "Message",
    "Service",
    "deserialize",
    "interface",
    "message_class",
    "register_message_modules",
    "serialize",
    "service_class",
    "type_hash",
]


class Service:
    """Base of service classes, which carry the classes of their request and response."""

    __msgtype__: ClassVar[str]
    Request: ClassVar[type[Message]]
    Response: ClassVar[type[Message]]

    def __init__(self) -> None:
        raise TypeError("Service classes can not be instantiated")


@cache
def service_class(name: str) -> type[Service]:
    """The class of the service ``name``, for example ``std_srvs/srv/Trigger``.

    Raises:
        InterfaceError: there is no such service.
    """
    package, _, short_name = name.rpartition("/srv/")
    if short_name not in service_names(package):
        raise InterfaceError(
            f"there is no service {name!r} without ROS 2; there are rcl_interfaces' and std_srvs'"
        )
    return type(
        short_name,
        (Service,),
        {
            "__module__": f"{package}.srv",
            "__msgtype__": name,
            "Request": message_class(f"{name}_Request"),
            "Response": message_class(f"{name}_Response"),
        },
    )


def register_message_modules() -> None:
    """Make ``geometry_msgs.msg`` and the like importable, where no real package has that name.

    Classes are built when they are first asked for.
    """
    for package in packages():
        if package in sys.modules or importlib.util.find_spec(package) is not None:
            continue
        parent = ModuleType(package, f"Messages of {package}, provided by {__package__}.")
        parent.__path__ = []
        sys.modules[package] = parent
        for folder, names in (("msg", message_names(package)), ("srv", service_names(package))):
            if names:
                module = _InterfaceModule(package, folder, names)
                sys.modules[module.__name__] = module
                setattr(parent, folder, module)


class _InterfaceModule(ModuleType):
    """A module whose attributes are built on first use."""

    def __init__(self, package: str, folder: str, names: list[str]) -> None:
        super().__init__(f"{package}.{folder}", f"Interfaces of {package}.")
        self.__all__ = names
        self._build = message_class if folder == "msg" else service_class

    def __getattr__(self, name: str) -> Any:
        prefix = self.__name__.replace(".", "/")
        if name in self.__all__:
            cls: Any = self._build(f"{prefix}/{name}")
        elif name.endswith(("_Request", "_Response")) and (name.rpartition("_")[0] in self.__all__):
            cls = message_class(f"{prefix}/{name}")
        else:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        setattr(self, name, cls)
        return cls

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.__all__]
