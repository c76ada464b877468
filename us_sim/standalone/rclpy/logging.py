"""Loggers by name; their levels; and where messages go: standard error and the topic /rosout.

Names with dots form a tree: a logger without a level takes its parent's, at the top the default.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from types import FrameType
from typing import Any

from .time import Clock


class LoggingSeverity(IntEnum):
    """The severities of ROS; UNSET means that the parent logger decides."""

    UNSET = 0
    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_COLORS = {
    LoggingSeverity.DEBUG: "\033[32m",
    LoggingSeverity.INFO: "\033[0m",
    LoggingSeverity.WARN: "\033[33m",
    LoggingSeverity.ERROR: "\033[31m",
    LoggingSeverity.FATAL: "\033[31m",
}


@dataclass(frozen=True)
class Record:
    """One log message and where it came from."""

    severity: LoggingSeverity
    name: str
    node: str  # the logger of the node that the logger belongs to, itself where there is none
    message: str
    function: str
    file: str
    line: int
    stamp: int  # ns since the epoch


rosout: dict[str, Callable[[Record], None]] = {}  # publishing functions, by nodes' loggers

_lock = threading.RLock()
_levels = {"": LoggingSeverity.INFO}
_disabled: frozenset[str] = frozenset()
_users = 0


def configure(arguments: Any) -> None:
    """Take log levels and outputs from the first context that is up."""
    global _users, _disabled
    with _lock:
        _users += 1
        if _users > 1:
            return
        if arguments.log_level is not None:
            _levels[""] = arguments.log_level
        _levels.update(arguments.logger_levels)
        _disabled = arguments.disabled_outputs


def release() -> None:
    """The counterpart of `configure`; after the last one the outputs are as at the start."""
    global _users, _disabled
    with _lock:
        _users -= 1
        if not _users:
            _disabled = frozenset()


def get_logger(name: str) -> RcutilsLogger:
    """The logger of a name; raises ValueError for an empty one."""
    if not name:
        raise ValueError("Logger name must not be empty.")
    return RcutilsLogger().get_child(name)


def set_logger_level(
    name: str,
    level: int | LoggingSeverity,
    detailed_error: bool = False,  # noqa: ARG001
) -> None:
    """Give a logger a level of its own; raises ValueError when it is no LoggingSeverity."""
    _levels[name] = LoggingSeverity(level)


def get_logger_effective_level(name: str) -> LoggingSeverity:
    while name:
        if level := _levels.get(name):
            return level
        name = name.rpartition(".")[0]
    return _levels[""]


def emit(record: Record) -> None:
    """Write a record to the console, and publish it if its logger belongs to a node."""
    if "stdout" not in _disabled:
        _write(record)
    publish = rosout.get(record.node)
    if publish is not None and "rosout" not in _disabled:
        publish(record)


def _write(record: Record) -> None:
    environment = os.environ
    stream = sys.stdout if environment.get("RCUTILS_LOGGING_USE_STDOUT") == "1" else sys.stderr
    if stream is None:
        return
    seconds, nanoseconds = divmod(record.stamp, 1_000_000_000)
    moment = f"[{seconds}.{nanoseconds:09d}]"
    text = f"[{record.severity.name}] {moment} [{record.name}]: {record.message}"
    colorized = environment.get("RCUTILS_COLORIZED_OUTPUT", "")
    if colorized == "1" or (colorized != "0" and stream.isatty()):
        text = f"{_COLORS[record.severity]}{text}\033[0m"
    try:
        stream.write(text + "\n")
        stream.flush()
    except (OSError, ValueError):
        pass  # a closed or broken stream must not end the node that logs


_SYSTEM_CLOCK = Clock()
_OPTIONS = ["throttle_duration_sec", "throttle_time_source_type", "skip_first", "once"]


def _writer(severity: LoggingSeverity) -> Callable[..., bool]:
    def write(self, message, **kwargs):
        return self.log(message, severity, **kwargs)

    return write


class RcutilsLogger:
    """Writes messages under a name; names with dots form a tree."""

    def __init__(self, name=""):
        self.name = name
        self._node_logger = name  # whose publisher on /rosout is used
        self._contexts: dict[tuple[Any, ...], dict[str, Any]] = {}

    def get_child(self, name):
        """The logger under this one; raises ValueError for an empty name."""
        if not name:
            raise ValueError("Child logger name must not be empty.")
        child = RcutilsLogger(f"{self.name}.{name}" if self.name else name)
        if self._node_logger in rosout:
            child._node_logger = self._node_logger
        return child

    def set_level(self, level):
        set_logger_level(self.name, level)

    def get_effective_level(self):
        return get_logger_effective_level(self.name)

    def is_enabled_for(self, severity):
        return LoggingSeverity(severity) >= self.get_effective_level()

    def log(self, message, severity, **kwargs):
        """Write a message; True when it was not filtered out."""
        severity = LoggingSeverity(severity)
        if severity < self.get_effective_level():
            return False
        frame = _calling_frame()
        name = kwargs.pop("name", self.name)
        if kwargs and not self._passes_filters(frame, severity, name, kwargs):
            return False
        code = frame.f_code
        emit(
            Record(
                severity,
                name,
                self._node_logger,
                str(message),
                code.co_name,
                code.co_filename,
                frame.f_lineno,
                time.time_ns(),
            )
        )
        return True

    debug = _writer(LoggingSeverity.DEBUG)
    info = _writer(LoggingSeverity.INFO)
    warning = warn = _writer(LoggingSeverity.WARN)
    error = _writer(LoggingSeverity.ERROR)
    fatal = _writer(LoggingSeverity.FATAL)

    def _passes_filters(
        self, frame: FrameType, severity: LoggingSeverity, name: str, options: dict[str, Any]
    ) -> bool:
        clock = _throttle_clock(options)
        asked = {
            "Logger severity": severity,
            "Logger name": name,
            "Requested logging filters": {option for option in options if options[option]},
            "Logging filter parameters": options,
        }
        place = (frame.f_code.co_filename, frame.f_lineno, frame.f_lasti)
        context = self._contexts.setdefault(place, asked)
        for subject, value in asked.items():
            if value != context[subject]:
                raise ValueError(f"{subject} cannot be changed between calls.")
        if period := options.get("throttle_duration_sec"):
            now = clock.now().nanoseconds
            if now < context.get("last_logged", 0) + period * 1e9:
                return False
            context["last_logged"] = now
        if options.get("skip_first") and not context.get("has_skipped"):
            context["has_skipped"] = True
            return False
        if options.get("once"):
            had_logged, context["has_logged"] = context.get("has_logged"), True
            return not had_logged
        return True


def _throttle_clock(options: dict[str, Any]) -> Clock:
    """The clock that throttles; raises TypeError or ValueError when the options are none."""
    for name in options:
        if name not in _OPTIONS:
            raise TypeError(
                f'parameter "{name}" is not one of the recognized logging options "{_OPTIONS}"'
            )
    clock = options.get("throttle_time_source_type", _SYSTEM_CLOCK)
    if not isinstance(clock, Clock):
        raise ValueError(f'Received throttle_time_source_type of "{clock}" is not a clock instance')
    if "throttle_time_source_type" in options and "throttle_duration_sec" not in options:
        raise TypeError(
            'required parameter "throttle_duration_sec" not specified '
            'but is required for the the logging filter "throttle"'
        )
    return clock


def _calling_frame() -> FrameType:
    """The frame outside of this file that logs."""
    frame = sys._getframe(1)
    while frame.f_code.co_filename == __file__ and frame.f_back is not None:
        frame = frame.f_back
    return frame
