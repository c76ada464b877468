"""Files of Fast DDS in shared memory, which processes that were killed leave there.

Fast DDS locks a file ``fastrtps_NAME_el`` or ``_sl`` (flock) before it makes the segment
``fastrtps_NAME``, and looks whether somebody removed that file meanwhile; the lock goes with the
process. `fastdds shm clean` relies on the same. A port that one of several processes was killed
with is never removed by the others, though none of them listens to it any more.
"""

from __future__ import annotations

import contextlib
import os
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


def remove_unused_ports() -> None:
    """Remove ports to which nobody listens, and which no other process has in its memory."""
    ports = {each for each in FOLDER.glob("fastrtps_port*") if each.name[-3:] not in ("_el", "_sl")}
    for maps in set(Path("/proc").glob("[0-9]*/maps")) - {Path(f"/proc/{os.getpid()}/maps")}:
        with contextlib.suppress(OSError):
            mapped = maps.read_text(errors="replace")
            ports = {each for each in ports if f"{each}\n" not in mapped}
    for port in ports:
        if not any((FOLDER / f"{port.name}{end}").exists() for end in ("_el", "_sl")):
            with contextlib.suppress(OSError):
                port.unlink()
                (FOLDER / f"sem.{port.name}_mutex").unlink()
