"""Publishing what a node logs on /rosout."""

from contextlib import suppress
from typing import Any

from ..messages import message_class
from . import _logging_outputs as outputs
from ._endpoints import NodeLink
from ._rclpy_pybind11 import InvalidHandle, RCLError
from .duration import Duration
from .publisher import Publisher
from .qos import DurabilityPolicy, QoSProfile
from .time import Time

Log: Any = message_class("rcl_interfaces/msg/Log")
_QOS = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)
)


class Rosout:
    """One node's publisher on /rosout, which late listeners hear too."""

    def __init__(self, link: NodeLink) -> None:
        self._name = link.logger_name
        self.publisher = Publisher(link, Log, "/rosout", "/rosout", _QOS)
        outputs.add_rosout(self._name, self._publish)

    def _publish(self, record: outputs.Record) -> None:
        message = Log(
            stamp=Time(nanoseconds=record.stamp).to_msg(),
            level=int(record.severity),
            name=record.name,
            msg=record.message,
            file=record.file,
            function=record.function,
            line=record.line,
        )
        with suppress(InvalidHandle, RCLError):  # a node may say something while it ends
            self.publisher.publish(message)

    def destroy(self) -> None:
        """Publish nothing more."""
        outputs.remove_rosout(self._name)
        self.publisher.destroy()
