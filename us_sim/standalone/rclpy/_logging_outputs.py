"""Where log messages go: standard error in the ROS format, and the topic /rosout.

Levels belong to logger names: a logger without one takes its parent's, and at the top the default.
"""

import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass

from ._arguments import Arguments
from .impl.logging_severity import LoggingSeverity

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


_lock = threading.RLock()
_levels: dict[str, LoggingSeverity] = {}
_default_level = LoggingSeverity.INFO
_disabled: frozenset[str] = frozenset()
_users = 0
_rosout: dict[str, Callable[[Record], None]] = {}


def configure(arguments: Arguments) -> None:
    """Take log levels and outputs from the first context that is up."""
    global _users, _default_level, _disabled
    with _lock:
        _users += 1
        if _users > 1:
            return
        if arguments.log_level is not None:
            _default_level = arguments.log_level
        _levels.update(arguments.logger_levels)
        _disabled = arguments.disabled_outputs


def release() -> None:
    """The counterpart of `configure`; after the last one the outputs are as at the start."""
    global _users, _disabled
    with _lock:
        _users -= 1
        if not _users:
            _disabled = frozenset()


def set_level(name: str, level: LoggingSeverity) -> None:
    """Give a logger a level of its own; the unnamed one has the default."""
    global _default_level
    with _lock:
        if name:
            _levels[name] = level
        else:
            _default_level = level


def effective_level(name: str) -> LoggingSeverity:
    """The level that holds for a logger: its own, its nearest ancestor's, or the default."""
    while name and _levels:
        level = _levels.get(name, LoggingSeverity.UNSET)
        if level:
            return level
        name = name.rpartition(".")[0]
    return _default_level


def add_rosout(name: str, publish: Callable[[Record], None]) -> None:
    """Publish what a node's logger says."""
    with _lock:
        _rosout[name] = publish


def remove_rosout(name: str) -> None:
    """Stop publishing what a node's logger and its children say."""
    with _lock:
        _rosout.pop(name, None)


def is_published(name: str) -> bool:
    """Whether a logger is a node's whose messages are published."""
    return name in _rosout


def emit(record: Record) -> None:
    """Write a record to the console, and publish it if its logger belongs to a node."""
    if "stdout" not in _disabled:
        _write(record)
    publish = _rosout.get(record.node)
    if publish is not None and "rosout" not in _disabled:
        publish(record)


def _write(record: Record) -> None:
    environment = os.environ
    stream = sys.stdout if environment.get("RCUTILS_LOGGING_USE_STDOUT") == "1" else sys.stderr
    if stream is None:
        return
    seconds, nanoseconds = divmod(record.stamp, 1_000_000_000)
    moment = f"{seconds}.{nanoseconds:09d}"
    text = f"[{record.severity.name}] [{moment}] [{record.name}]: {record.message}"
    colorized = environment.get("RCUTILS_COLORIZED_OUTPUT", "")
    if colorized == "1" or (colorized != "0" and stream.isatty()):
        text = f"{_COLORS[record.severity]}{text}\033[0m"
    try:
        stream.write(text + "\n")
        stream.flush()
    except (OSError, ValueError):
        pass  # a closed or broken stream must not end the node that logs
