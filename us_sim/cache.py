"""Arrays kept in the user's cache folder, memory-mapped and shared by processes.

An entry is a folder of .npy files and a description. It is renamed to its place when it is whole.
A lock lets one process make it while others wait. What cannot be read is made again.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs
from filelock import FileLock
from numpy.typing import NDArray

Thing = TypeVar("Thing")
Arrays = dict[str, NDArray[Any]]
Facts = dict[str, Any]

_logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Return US_SIM_CACHE, or the user's cache folder on this system."""
    given = os.environ.get("US_SIM_CACHE")
    return Path(given) if given else platformdirs.user_cache_path("us_sim")


def load_or_create(
    key: str,
    pack: Callable[[Thing], tuple[Arrays, Facts]],
    unpack: Callable[[Arrays, Facts], Thing],
    make: Callable[[], Thing],
) -> Thing:
    """Load the thing kept under a key, or make and keep it; warn if the folder cannot be written.

    Args:
        key: a file name that says all that decides the thing's bytes.
        pack: takes a thing apart, into arrays by name and facts that JSON can hold.
        unpack: makes it from these again.
        make: makes the thing; called by one process at a time.
    """
    entry, made = cache_folder() / key, None
    if (found := _load(entry, unpack)) is not None:
        return found
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(entry.with_name(f"{key}.lock")):
            if (found := _load(entry, unpack)) is None:
                made = make()
                _store(entry, *pack(made))
                found = _load(entry, unpack)  # mapped: of no use is the copy in memory
    except OSError as error:
        _logger.warning("%s cannot be written (%s), so it is not kept", entry, error)
    if found is None:
        return make() if made is None else made
    return found


def _load(entry: Path, unpack: Callable[[Arrays, Facts], Thing]) -> Thing | None:
    """Load the entry's thing; None where it is absent or damaged."""
    try:
        # Plain arrays over the maps: a subclass would slow and surprise callers.
        arrays = {f.stem: np.asarray(np.load(f, mmap_mode="r")) for f in entry.glob("*.npy")}
        return unpack(arrays, json.loads((entry / "facts.json").read_text(encoding="utf-8")))
    except Exception:  # whatever a damaged entry leads to
        return None


def _store(entry: Path, arrays: Arrays, facts: Facts) -> None:
    """Write an entry; the caller holds its lock."""
    if entry.exists():
        _logger.warning("%s is damaged, so it is made again", entry)
    partial = entry.with_name(f"{entry.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
    try:
        partial.mkdir()
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array)
        (partial / "facts.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
        shutil.rmtree(entry, ignore_errors=True)  # damaged
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
