"""Going before ordinary programs, so that what else runs does not hold up the images.

Where every core is kept busy, the scheduler hands a process that has just woken up a core only
after some milliseconds, and so to each node that a pose passes through. Linux lets threads go first
(SCHED_RR) where the user may ask for that: as root, or with a line ``USER - rtprio 1`` in
``/etc/security/limits.conf``.
"""

from __future__ import annotations

import contextlib
import os

_PRIORITY = 1
"""The lowest of those that go first: drivers of devices may go before."""


def go_first() -> str:
    """Let all present threads of this process go before ordinary ones, and none that they start.

    Returns:
        How they run from now on: ``realtime``, or ``ordinary`` where that is not allowed.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "ordinary"
    return "realtime" if _schedule(os.SCHED_RR, _PRIORITY) else "ordinary"


def go_along() -> None:
    """Let all present threads of this process run as ordinary programs again."""
    if hasattr(os, "sched_setscheduler"):
        _schedule(os.SCHED_OTHER, 0)


def _schedule(policy: int, priority: int) -> bool:
    policy |= getattr(os, "SCHED_RESET_ON_FORK", 0)
    try:
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread), policy, os.sched_param(priority))
    except OSError:
        return False
    return True


def scheduling_of(pid: int) -> str:
    """How the main thread of a process runs, in the words of `go_first`."""
    if not hasattr(os, "sched_getscheduler"):
        return "ordinary"
    try:
        policy = os.sched_getscheduler(pid)
    except OSError:  # it has ended
        return "ordinary"
    return (
        "realtime" if policy & ~getattr(os, "SCHED_RESET_ON_FORK", 0) == os.SCHED_RR else "ordinary"
    )
