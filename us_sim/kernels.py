"""Kernels: numba's `njit`, whose compiled code is kept for these very sources.

Numba compiles a kernel anew if its file changed, but not if a function that it calls did. So the
cache's folder is named by a hash of all such sources. It is below `NUMBA_CACHE_DIR`, or `kernels`
in the folder of `us_sim.cache`.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import re
import shutil
import tempfile
import time
from functools import partial
from importlib.util import source_hash
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from us_sim import __version__
from us_sim.cache import cache_folder

# A wrapper for C is a second copy of a kernel, and nothing here is called from C.
njit: Any = partial(numba.njit, no_cfunc_wrapper=True)


def enable_kernel_cache() -> None:
    """Have numba keep what it compiles in these sources' folder; remove old ones of others."""
    place = Path(getattr(config, "CACHE_DIR", "") or cache_folder() / "kernels")
    sources = b"".join(map(Path.read_bytes, find_kernel_sources()))
    name = f"us_sim-{__version__}-{source_hash(sources).hex()}"
    try:
        (place / name).mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=place / name).close()
        os.utime(place / name)
    except OSError as error:
        logging.getLogger(__name__).warning(
            "%s cannot be written (%s): kernels are kept for this run only", place, error
        )
        place = Path(tempfile.mkdtemp(prefix="us_sim-kernels-"))
        atexit.register(shutil.rmtree, place, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = str(place)  # for the processes that this one starts
    with contextlib.suppress(OSError):  # another process removes them, too
        for folder in sorted(place.glob("us_sim-*"), key=os.path.getmtime)[:-5]:
            if time.time() - os.path.getmtime(folder) > 86400.0:  # else it may be in use
                shutil.rmtree(folder, ignore_errors=True)
    config.CACHE_DIR = str(place / name)  # type: ignore[attr-defined]


def find_kernel_sources() -> list[Path]:
    """Find the package's files that name numba or a kernel; no other has a part in any."""
    files = sorted(Path(__file__).parent.rglob("*.py"))
    return [file for file in files if re.search(rb"numba|kernel", file.read_bytes())]


enable_kernel_cache()
