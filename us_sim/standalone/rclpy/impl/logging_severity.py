"""How important a log message is."""

from enum import IntEnum


class LoggingSeverity(IntEnum):
    """The severities of ROS; UNSET means that the parent logger decides."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50
