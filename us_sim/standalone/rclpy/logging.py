"""Loggers by name, and their levels.

>>> set_logger_level("skin", LoggingSeverity.ERROR)
>>> get_logger("skin").get_effective_level().name
'ERROR'
"""

from . import _logging_outputs as outputs
from .impl.logging_severity import LoggingSeverity
from .impl.rcutils_logger import RcutilsLogger

__all__ = [
    "LoggingSeverity",
    "get_logger",
    "get_logger_effective_level",
    "set_logger_level",
]

_root_logger = RcutilsLogger()


def get_logger(name: str) -> RcutilsLogger:
    """The logger of a name; raises ValueError for an empty one."""
    if not name:
        raise ValueError("Logger name must not be empty.")
    return _root_logger.get_child(name)


def set_logger_level(
    name: str,
    level: int | LoggingSeverity,
    detailed_error: bool = False,  # noqa: ARG001
) -> None:
    """Give a logger a level of its own; raises ValueError when it is no LoggingSeverity."""
    outputs.set_level(name, LoggingSeverity(level))


def get_logger_effective_level(name: str) -> LoggingSeverity:
    """The level that holds for a logger, its own or an inherited one."""
    return outputs.effective_level(name)
