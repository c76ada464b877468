"""The two services by which others read and set a node's log levels."""

from typing import TYPE_CHECKING, Any

from ..messages import message_class, service_class
from . import logging
from .qos import qos_profile_services_default

if TYPE_CHECKING:
    from .node import Node

__all__ = ["LoggingService"]


class LoggingService:
    """Offers `<node>/get_logger_levels` and `<node>/set_logger_levels`."""

    def __init__(self, node: "Node"):
        for type_name, service, callback in (
            ("GetLoggerLevels", "get_logger_levels", self._get_logger_levels),
            ("SetLoggerLevels", "set_logger_levels", self._set_logger_levels),
        ):
            node.create_service(
                service_class(f"rcl_interfaces/srv/{type_name}"),
                f"{node.get_name()}/{service}",
                callback,
                qos_profile=qos_profile_services_default,
            )

    def _get_logger_levels(self, request: Any, response: Any) -> Any:
        level = message_class("rcl_interfaces/msg/LoggerLevel")
        response.levels = [
            level(name=name, level=int(logging.get_logger_level(name))) for name in request.names
        ]
        return response

    def _set_logger_levels(self, request: Any, response: Any) -> Any:
        results = []
        for level in request.levels:
            result: Any = message_class("rcl_interfaces/msg/SetLoggerLevelsResult")(successful=True)
            try:
                logging.set_logger_level(level.name, level.level)
            except ValueError:
                result.successful = False
                result.reason = "Failed reason: Invalid logger level."
            results.append(result)
        response.results = results
        return response
