"""How an executor's wait can end without anything to run, and how long it may take."""

__all__ = [
    "ConditionReachedException",
    "ExternalShutdownException",
    "ShutdownException",
    "TimeoutException",
    "TimeoutObject",
]


class TimeoutException(Exception):
    """Nothing was ready in time."""


class ShutdownException(Exception):
    """The executor was shut down."""


class ExternalShutdownException(Exception):
    """The context was shut down."""


class ConditionReachedException(Exception):
    """What was waited for happened."""


class TimeoutObject:
    """A timeout that its owner may change between waits."""

    def __init__(self, timeout: float):
        self.timeout = timeout
