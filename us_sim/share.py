"""Paths of the installed scenes, launch file, layouts and probe paths."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
from collections.abc import Iterator
from pathlib import Path

from us_sim.errors import UsSimError


def full_path(name: str | Path) -> Path:
    """Expand ``~`` and follow links; unlike `Path`'s methods it leaves a wrong path as it is."""
    return Path(os.path.realpath(os.path.expanduser(name)))


def shared_roots() -> Iterator[Path]:
    """Yield folders with ``config`` and ``bags``: the checkout, ROS 2 prefixes, pip's share."""
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / "package.xml").is_file():
        yield checkout
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / "share" / "us_sim"
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        for file in importlib.metadata.files("us_sim") or []:
            if file.parts[-3:] == ("share", "us_sim", "package.xml"):
                yield Path(str(file.locate())).resolve().parent


def shared_path(relative: str) -> Path:
    """Return the first of :func:`shared_roots` that has it, joined with ``relative``."""
    for root in (roots := [*shared_roots()]):
        if (root / relative).exists():
            return root / relative
    raise UsSimError(
        f"{relative} is not installed with us_sim (looked in "
        f"{', '.join(map(str, roots)) or 'no folder at all'}); install the package again"
    )


def find_bag(name: str | Path) -> Path:
    """Return the path of a bag, or of the installed one of that name."""
    path = Path(os.path.expanduser(name))
    if os.path.exists(path) or path.name != str(name):
        return path
    installed = (root / "bags" / path for root in shared_roots())
    return next(filter(os.path.exists, installed), path)
