"""The process that decodes compressed images, and may end of one.

It is run as a script, imports nothing of this package, reads what to decode as JSON from stdin,
and writes the images one after another to stdout; what is wrong is a line of JSON on stderr.
Decoders are large programs in C and C++ that are handed a stranger's bytes: here one that fails
ends nothing else, and memory and time are bounded.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import warnings
from pathlib import Path

MISSING, WRONG = "missing", "wrong"


def main() -> int:
    """Decode; 0 when all images were written."""
    task = json.loads(sys.stdin.buffer.readline())
    out = os.fdopen(os.dup(1), "wb", buffering=1 << 20)
    os.dup2(2, 1)  # what a decoder prints is no image
    warnings.simplefilter("ignore")
    from pydicom import config
    from pydicom.pixels import get_decoder, iter_pixels

    config.settings.reading_validation_mode = config.IGNORE
    try:
        decoder = get_decoder(task["syntax"])
    except NotImplementedError:
        return _end(WRONG, "no decoder")
    if not decoder.is_available:
        return _end(MISSING, "; ".join(decoder.missing_dependencies))
    _bound(task["memory"], task["seconds"])
    shape, size = tuple(task["shape"]), task["bytes"]
    for job in task["files"]:
        try:
            for frame in iter_pixels(job["path"], indices=job["frames"], raw=False):
                if frame.shape != shape or frame.dtype.itemsize != size:
                    return _end(WRONG, f"{frame.shape} {frame.dtype}")
                out.write(frame.astype(frame.dtype.newbyteorder("<"), copy=False).tobytes())
        except MemoryError:
            return _end(WRONG, "memory")
        except BrokenPipeError:
            return 1
        except Exception as error:  # whatever the bytes of a damaged image lead to
            return _end(WRONG, type(error).__name__)
    out.flush()
    return 0


def _bound(memory: int, seconds: int) -> None:
    """Allow so many more bytes of memory and seconds of processor time, and no file to be left."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def _end(kind: str, why: str) -> int:
    print(json.dumps({"kind": kind, "why": why}), file=sys.stderr)
    return 3


if __name__ == "__main__":
    sys.exit(main())
