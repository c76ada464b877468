"""Waiting for what other threads and processes do, for a while."""

import time
from collections.abc import Callable
from typing import Any


def until(done: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
    """Until it is done, and what it then gives; fail with what was waited for after so long."""
    deadline = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
    return found
