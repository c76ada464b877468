"""Loggers, with the filters `once`, `skip_first` and `throttle_duration_sec`.

>>> logger = RcutilsLogger("probe").get_child("camera")
>>> logger.name, logger.is_enabled_for(LoggingSeverity.DEBUG)
('probe.camera', False)
"""

import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from .. import _logging_outputs as outputs
from ..clock import Clock
from .logging_severity import LoggingSeverity

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
        if outputs.is_published(self._node_logger):
            child._node_logger = self._node_logger
        return child

    def set_level(self, level):
        """Give this logger a level of its own."""
        outputs.set_level(self.name, LoggingSeverity(level))

    def get_effective_level(self):
        """The level that holds for this logger, its own or an inherited one."""
        return outputs.effective_level(self.name)

    def is_enabled_for(self, severity):
        """Whether messages of a severity are written."""
        return LoggingSeverity(severity) >= outputs.effective_level(self.name)

    def log(self, message, severity, **kwargs):
        """Write a message; True when it was not filtered out."""
        severity = LoggingSeverity(severity)
        if severity < outputs.effective_level(self.name):
            return False
        frame = _calling_frame()
        name = kwargs.pop("name", self.name)
        if kwargs and not self._passes_filters(frame, severity, name, kwargs):
            return False
        code = frame.f_code
        outputs.emit(
            outputs.Record(
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
