"""Files of Fast DDS in shared memory, which processes that were killed leave there.

Fast DDS locks a file ``fastrtps_NAME_el`` or ``_sl`` (flock) before it makes the segment
``fastrtps_NAME``, and looks whether somebody removed that file meanwhile; the lock goes with the
process. `fastdds shm clean` relies on the same.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

FOLDER = Path("/dev/shm")  # on Linux; elsewhere there is none


def remove_abandoned_segments() -> None:
    """Remove segments of processes that have ended; those of others, and of living ones, stay."""
    for lock in [*FOLDER.glob("fastrtps_*_el"), *FOLDER.glob("fastrtps_*_sl")]:
        import fcntl  # not on Windows

        name = lock.name[:-3]
        with contextlib.suppress(OSError), lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for each in (name, f"sem.{name}_mutex", lock.name):  # the lock is the last
                with contextlib.suppress(FileNotFoundError):
                    (FOLDER / each).unlink()
