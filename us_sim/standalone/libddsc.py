"""Find Eclipse Cyclone DDS's C library on this machine, and refuse one that will not do."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from .middleware import MiddlewareError

OLDEST, TOO_NEW = (0, 10), (12, 0)
"""Versions whose structures are as `ddsc` has them: those of ROS 2 Jazzy (0.10.5) to 11."""

_NAMES = ("libddsc.so", "libddsc.so.[0-9]*", "libddsc.dylib", "ddsc.dll")
_VERSION = re.compile(r"ddsc\b.*?(\d+)\.(\d+)\.\d+")
_ROS = Path("/opt/ros")


class DdsError(MiddlewareError):
    """Cyclone DDS refuses a request, or cannot be found."""


def load(needed: Iterable[str], environment: Mapping[str, str] = os.environ) -> Any:
    """The first library that can be loaded and has all the functions that are needed.

    Raises:
        DdsError: there is none, or not the one that US_SIM_DDSC names.
    """
    chosen = environment.get("US_SIM_DDSC")
    refused = []
    for path in [Path(chosen)] if chosen else _candidates(environment):
        if isinstance(library := _loaded(path, needed), str):
            refused.append(f"{path} {library}")
        else:
            return library
    hint = "set US_SIM_DDSC to libddsc.so of Cyclone DDS 0.10 or 11, or run pip install cyclonedds"
    raise DdsError(
        f"the C library of Cyclone DDS cannot be found: "
        f"{'; '.join(refused) or 'there is none on this machine'}; {hint}"
    )


def _candidates(environment: Mapping[str, str]) -> Iterator[Path]:
    """Files that may be the library, the likeliest first."""
    if home := environment.get("CYCLONEDDS_HOME"):
        yield from _within(Path(home) / "lib")
        yield from _within(Path(home) / "bin")
    yield from _in_the_wheel()
    for release in sorted(_ROS.glob("*"), reverse=True):
        for folder in (release / "lib", *sorted(release.glob("lib/*-linux-gnu"))):
            yield from _within(folder)
    if name := ctypes.util.find_library("ddsc"):
        yield Path(name)


def _within(folder: Path) -> Iterator[Path]:
    for name in _NAMES:
        yield from sorted(folder.glob(name))


def _in_the_wheel() -> Iterator[Path]:
    """The library in the package `cyclonedds`, which is not imported for this (0.2 s)."""
    package = importlib.util.find_spec("cyclonedds")
    if package is None or package.origin is None:
        return
    folder = Path(package.origin).parent
    for place in (folder.parent / "cyclonedds.libs", folder / ".dylibs"):
        yield from sorted(place.glob("*ddsc[.-]*"))
    try:  # built from source, it knows where its library is
        from cyclonedds.internal import DDS
    except Exception:  # whatever a broken installation raises
        return
    yield Path(DDS._dll_handle._name)


def _loaded(path: Path, needed: Iterable[str]) -> Any:
    """The library; or, as text, why it will not do."""
    named = _VERSION.search(path.resolve().name)  # a loader's name has no folder, nor a version
    version = (int(named[1]), int(named[2])) if named else OLDEST
    if not OLDEST <= version < TOO_NEW:
        return f"is of version {version[0]}.{version[1]}, but 0.10 to 11 are known here"
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return f"cannot be loaded ({error})"
    missing = [name for name in needed if not hasattr(library, name)]
    return f"has no {missing[0]}" if missing else library
