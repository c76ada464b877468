"""Paths of the installed scenes, launch file, layouts and probe paths."""

from __future__ import annotations

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
    try:
        distribution = importlib.metadata.distribution("us_sim")
    except importlib.metadata.PackageNotFoundError:
        return
    for file in distribution.files or []:
        if file.parts[-3:] == ("share", "us_sim", "package.xml"):
            yield Path(str(distribution.locate_file(file))).resolve().parent


def shared_path(relative: str) -> Path:
    """Return the first of :func:`shared_roots` that has it, joined with ``relative``."""
    roots = list(shared_roots())
    for root in roots:
        if (root / relative).exists():
            return root / relative
    raise UsSimError(
        f"{relative} is not installed with us_sim (looked in "
        f"{', '.join(map(str, roots)) or 'no folder at all'}); install the package again"
    )


def find_bag(name: str | Path) -> Path:
    """Return the path of a bag, or of the installed one of that name."""
    path = Path(os.path.expanduser(name))
    if not os.path.exists(path) and path.name == str(name):
        for root in shared_roots():
            if os.path.exists(root / "bags" / path):
                return root / "bags" / path
    return path
