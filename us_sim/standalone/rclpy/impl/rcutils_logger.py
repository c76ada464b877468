"""Loggers, with the filters `once`, `skip_first` and `throttle_duration_sec`.

>>> logger = RcutilsLogger("probe").get_child("camera")
>>> logger.name, logger.is_enabled_for(LoggingSeverity.DEBUG)
('probe.camera', False)
"""

import sys
import time
from types import FrameType
from typing import Any

from .. import _logging_outputs as outputs
from ..clock import Clock
from .logging_severity import LoggingSeverity

__all__ = ["RcutilsLogger"]

_SYSTEM_CLOCK = Clock()
_FILTER_DEFAULTS: dict[str, dict[str, Any]] = {  # a filter's parameters; None has to be given
    "throttle": {"throttle_duration_sec": None, "throttle_time_source_type": _SYSTEM_CLOCK},
    "skip_first": {"skip_first": None},
    "once": {"once": None},
}
_PARAMETERS = [name for parameters in _FILTER_DEFAULTS.values() for name in parameters]


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

    def debug(self, message, **kwargs):
        """Write a message with severity DEBUG."""
        return self.log(message, LoggingSeverity.DEBUG, **kwargs)

    def info(self, message, **kwargs):
        """Write a message with severity INFO."""
        return self.log(message, LoggingSeverity.INFO, **kwargs)

    def warning(self, message, **kwargs):
        """Write a message with severity WARN."""
        return self.log(message, LoggingSeverity.WARN, **kwargs)

    def warn(self, message, **kwargs):
        """Write a message with severity WARN."""
        return self.warning(message, **kwargs)

    def error(self, message, **kwargs):
        """Write a message with severity ERROR."""
        return self.log(message, LoggingSeverity.ERROR, **kwargs)

    def fatal(self, message, **kwargs):
        """Write a message with severity FATAL."""
        return self.log(message, LoggingSeverity.FATAL, **kwargs)

    def _passes_filters(
        self, frame: FrameType, severity: LoggingSeverity, name: str, kwargs: dict[str, Any]
    ) -> bool:
        wanted = _wanted_filters(kwargs)
        place = (frame.f_code.co_filename, frame.f_lineno, frame.f_lasti)
        context = self._contexts.get(place)
        if context is None:
            context = {"severity": severity, "name": name, "filters": wanted, **kwargs}
            self._contexts[place] = context
        elif severity != context["severity"]:
            raise ValueError("Logger severity cannot be changed between calls.")
        elif name != context["name"]:
            raise ValueError("Logger name cannot be changed between calls.")
        elif wanted != context["filters"]:
            raise ValueError("Requested logging filters cannot be changed between calls.")
        elif any(context.get(key) != value for key, value in kwargs.items()):
            raise ValueError("Logging filter parameters cannot be changed between calls.")
        return all(_FILTERS[kind](context) for kind in wanted)


def _wanted_filters(kwargs: dict[str, Any]) -> list[str]:
    """Which filters the keywords ask for; completes the keywords with defaults."""
    wanted = [
        kind
        for kind, parameters in _FILTER_DEFAULTS.items()
        if any(kwargs.get(name) for name in parameters)
    ]
    for kind in wanted:
        for name, default in _FILTER_DEFAULTS[kind].items():
            if name not in kwargs:
                if default is None:
                    raise TypeError(
                        f'required parameter "{name}" not specified '
                        f'but is required for the the logging filter "{kind}"'
                    )
                kwargs[name] = default
    for name in kwargs:
        if name not in _PARAMETERS:
            raise TypeError(
                f'parameter "{name}" is not one of the recognized logging options "{_PARAMETERS}"'
            )
    clock = kwargs.get("throttle_time_source_type", _SYSTEM_CLOCK)
    if not isinstance(clock, Clock):
        raise ValueError(f'Received throttle_time_source_type of "{clock}" is not a clock instance')
    return wanted


def _throttle(context: dict[str, Any]) -> bool:
    now = context["throttle_time_source_type"].now().nanoseconds
    if now < context.get("last_logged", 0) + context["throttle_duration_sec"] * 1e9:
        return False
    context["last_logged"] = now
    return True


def _skip_first(context: dict[str, Any]) -> bool:
    skipped = context.get("has_skipped", False)
    context["has_skipped"] = True
    return skipped


def _once(context: dict[str, Any]) -> bool:
    logged = context.get("has_logged", False)
    context["has_logged"] = True
    return not logged


_FILTERS = {"throttle": _throttle, "skip_first": _skip_first, "once": _once}


def _calling_frame() -> FrameType:
    """The frame outside of this file that logs."""
    frame = sys._getframe(1)
    while frame.f_code.co_filename == __file__ and frame.f_back is not None:
        frame = frame.f_back
    return frame
