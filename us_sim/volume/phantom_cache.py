"""Volumes kept in the user's cache folder, memory-mapped and shared by processes.

An entry is a folder of two .npy files and a description with their checksums. It is written
beside its place and renamed there, so it is whole or absent; a lock lets one process make it
while others wait; and what is damaged all the same is noticed and made again.

>>> import os, tempfile
>>> from us_sim.volume.phantom_cache import kept_volume
>>> from us_sim.volume.phantom import upper_arm
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CACHE"]:
...     made = kept_volume("arm", lambda: upper_arm(seed=1, voxel_size=3e-3))
...     kept = kept_volume("arm", lambda: 1 / 0)
...     bool((made.labels == kept.labels).all())
True
>>> del os.environ["US_SIM_CACHE"]
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import platformdirs
from filelock import FileLock, Timeout

from us_sim.errors import VolumeError
from us_sim.volume.volume import Volume

__all__ = ["cache_folder", "kept_volume"]

_DESCRIPTION = "volume.json"
_ARRAYS = ("intensities", "labels")
_WAIT = 0.5  # s, between two words to the person who waits for another process

_logger = logging.getLogger(__name__)


class _DamagedError(Exception):
    """An entry is there and cannot be used."""


def cache_folder() -> Path:
    """Where volumes are kept: US_SIM_CACHE, or the user's cache folder on this system."""
    given = os.environ.get("US_SIM_CACHE")
    return Path(given) if given else platformdirs.user_cache_path("us_sim")


def kept_volume(
    key: str, make: Callable[[], Volume], waiting: Callable[[], None] | None = None
) -> Volume:
    """The labelled volume kept under a key, made and kept first if it is not there.

    Where the cache folder cannot be written, the volume is made, used from memory, and a warning
    says so.

    Args:
        key: a file name that says all that decides the volume's bytes.
        make: makes the volume; called by one process at a time.
        waiting: called every half second while another process makes it.
    """
    entry = cache_folder() / key
    volume = _loaded(entry, warn=False)
    if volume is not None:
        return volume
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(entry.with_name(f"{key}.lock"))
        while not lock.is_locked:
            try:
                lock.acquire(timeout=_WAIT)
            except Timeout:
                if waiting is not None:
                    waiting()
    except OSError as error:
        _logger.warning("%s cannot be written (%s), so nothing is kept there", entry.parent, error)
        return make()
    try:
        volume = _loaded(entry, warn=True)
        if volume is not None:
            return volume
        made = make()
        try:
            _store(entry, made)
        except OSError as error:
            _logger.warning("%s cannot be written (%s), so it is not kept", entry, error)
            return made
        return _loaded(entry, warn=True) or made
    finally:
        lock.release()


def _loaded(entry: Path, *, warn: bool) -> Volume | None:
    """The entry's volume, or None where it is absent or damaged."""
    try:
        return _load(entry)
    except FileNotFoundError:
        return None
    except _DamagedError as error:
        if warn:
            _logger.warning("%s is damaged (%s), so it is made again", entry, error)
        return None


def _load(entry: Path) -> Volume:
    if not entry.exists():
        raise FileNotFoundError(entry)
    try:
        description = json.loads((entry / _DESCRIPTION).read_text(encoding="utf-8"))
        # A plain array over the map: a subclass would slow kernels and surprise callers.
        arrays = {
            name: np.asarray(np.load(entry / f"{name}.npy", mmap_mode="r")) for name in _ARRAYS
        }
        for name, array in arrays.items():
            if zlib.crc32(np.ascontiguousarray(array)) != description["crc32"][name]:
                raise _DamagedError(f"the checksum of {name} is wrong")
        return Volume(
            arrays["intensities"],
            np.array(description["index_to_patient"]),
            arrays["labels"],
            {int(label): name for label, name in description["label_names"].items()},
        )
    except (OSError, EOFError, ValueError, TypeError, KeyError, AttributeError, VolumeError) as e:
        raise _DamagedError(str(e)) from e


def _store(entry: Path, volume: Volume) -> None:
    """Write an entry; the caller holds its lock."""
    for left_over in entry.parent.glob(f"{entry.name}.partial-*"):
        shutil.rmtree(left_over, ignore_errors=True)
    partial = Path(tempfile.mkdtemp(prefix=f"{entry.name}.partial-", dir=entry.parent))
    try:
        checksums = {}
        for name in _ARRAYS:
            array = getattr(volume, name)
            np.save(partial / f"{name}.npy", array)
            checksums[name] = zlib.crc32(array)
        description = {
            "index_to_patient": volume.index_to_patient.tolist(),
            "label_names": volume.label_names,
            "crc32": checksums,
        }
        (partial / _DESCRIPTION).write_text(json.dumps(description, indent=1), encoding="utf-8")
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.exists():
            entry.unlink()
        partial.rename(entry)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
