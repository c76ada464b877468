"""Arrays kept in the user's cache folder, memory-mapped and shared by processes.

An entry is a folder of .npy files and a description. It is written beside its place and renamed
there, so it is whole or absent; a lock lets one process make it while others wait; and what cannot
be read all the same is made again.

>>> import os, tempfile
>>> import numpy as np
>>> from us_sim.cache import Form, kept
>>> form = Form("square.json", lambda x: ({"x": x}, {}), lambda arrays, facts: arrays["x"])
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CACHE"]:
...     made = kept("square", form, lambda: np.eye(2))
...     again = kept("square", form, lambda: 1 / 0)
...     bool((made == again).all())
True
>>> del os.environ["US_SIM_CACHE"]
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import platformdirs
from filelock import FileLock
from numpy.typing import NDArray

from us_sim.errors import UsSimError

Thing = TypeVar("Thing")

_DAMAGE = (OSError, EOFError, ValueError, TypeError, LookupError, AttributeError, UsSimError)

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Form(Generic[Thing]):
    """How a thing is laid down as arrays and facts, and made from them again."""

    description: str  # file name of the facts
    pack: Callable[[Thing], tuple[dict[str, NDArray], dict[str, Any]]]  # arrays, facts for JSON
    unpack: Callable[[dict[str, NDArray], dict[str, Any]], Thing]


def cache_folder() -> Path:
    """Where things are kept: US_SIM_CACHE, or the user's cache folder on this system."""
    given = os.environ.get("US_SIM_CACHE")
    return Path(given) if given else platformdirs.user_cache_path("us_sim")


def kept(key: str, form: Form[Thing], make: Callable[[], Thing]) -> Thing:
    """Return the thing kept under a key, made and kept first if it is not there.

    Where the cache folder cannot be written, the thing is made, used from memory, and a warning
    says so.

    Args:
        key: a file name that says all that decides the thing's bytes.
        form: how it is laid down.
        make: makes the thing; called by one process at a time.
    """
    entry, made = cache_folder() / key, None
    found = _load(entry, form)
    if found is not None:
        return found
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(entry.with_name(f"{key}.lock")):
            found = _load(entry, form, warn=True)
            if found is None:
                made = make()
                _store(entry, form, made)
                found = _load(entry, form)  # mapped: of no use is the copy in memory
    except OSError as error:
        _logger.warning("%s cannot be written (%s), so it is not kept", entry, error)
    if found is not None:
        return found
    return make() if made is None else made


def _load(entry: Path, form: Form[Thing], *, warn: bool = False) -> Thing | None:
    """Load the entry's thing; None where it is absent or damaged."""
    if not entry.exists():
        return None
    try:
        facts = json.loads((entry / form.description).read_text(encoding="utf-8"))
        # Mapped, so that only what is used takes memory; and a plain array over the map, since a
        # subclass would slow and surprise callers.
        files = entry.glob("*.npy")
        arrays = {file.stem: np.asarray(np.load(file, mmap_mode="r")) for file in files}
        return form.unpack(arrays, facts)
    except _DAMAGE as error:
        if warn:
            _logger.warning("%s is damaged (%s), so it is made again", entry, error)
        return None


def _store(entry: Path, form: Form[Thing], thing: Thing) -> None:
    """Write an entry; the caller holds its lock."""
    partial = entry.with_name(f"{entry.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
    try:
        partial.mkdir()
        arrays, facts = form.pack(thing)
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array)
        (partial / form.description).write_text(json.dumps(facts, indent=1), encoding="utf-8")
        shutil.rmtree(entry, ignore_errors=True)  # damaged
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
