"""The errors and records that rclpy's compiled part defines, importable under the same name."""

from dataclasses import dataclass

__all__ = [
    "InvalidHandle",
    "NodeNameNonExistentError",
    "RCLError",
    "RCLInvalidROSArgsError",
    "RCUtilsError",
    "RMWError",
    "UnknownROSArgsError",
    "UnsupportedEventTypeError",
    "rmw_request_id_t",
    "rmw_service_info_t",
]


class RCUtilsError(RuntimeError):
    """The logging or the argument machinery refused something."""


class RMWError(RuntimeError):
    """The middleware refused something."""


class RCLError(RuntimeError):
    """An operation on a node, an endpoint or a context failed."""


class RCLInvalidROSArgsError(RCLError):
    """An argument after --ros-args is malformed."""


class UnknownROSArgsError(RuntimeError):
    """An argument after --ros-args is none that ROS knows."""


class NodeNameNonExistentError(RCLError):
    """A question about a node that is not in the graph."""


class UnsupportedEventTypeError(RCLError):
    """A callback was given for an event that the middleware does not report."""


class InvalidHandle(RuntimeError):
    """Something that was destroyed is used."""


@dataclass(frozen=True)
class rmw_request_id_t:
    """Which request of which client: what a response has to carry back."""

    sequence_number: int
    writer_guid: int = 0  # 64 bits that name the client


@dataclass(frozen=True)
class rmw_service_info_t:
    """The identity of a request or response, and when it was sent and received (ns)."""

    source_timestamp: int
    received_timestamp: int
    request_id: rmw_request_id_t
