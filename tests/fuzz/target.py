"""Fuzzed readers: by name, files that are whole, and the function that reads a changed one."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["MODULES", "TARGETS", "Target", "add_targets", "target"]

MODULES = tuple(
    f"tests.fuzz.{room}"
    for room in ("bags", "volumes", "dicoms", "segmentations", "cases", "meshes", "scenes")
)
"""Where the targets are."""


@dataclass(frozen=True)
class Target:
    """A reader under attack."""

    name: str
    suffix: str  # of the file that it is given
    seeds: Callable[[Path], Iterable[bytes]]  # makes whole files, in a folder of its own
    read: Callable[[Path], object]  # ends with a result or a UsSimError


TARGETS: dict[str, Target] = {}


def add_targets(modules: Iterable[str]) -> None:
    """Import what adds targets."""
    for module in modules:
        importlib.import_module(module)


def target(
    name: str, suffix: str, seeds: Callable[[Path], Iterable[bytes]]
) -> Callable[[Callable[[Path], object]], Callable[[Path], object]]:
    """Attack the decorated function with changed seeds.

    It is called with the path of a changed file, and must return or raise a UsSimError. What it
    returns is checked by itself: an AssertionError is a failure like any other exception.
    """

    def add(read: Callable[[Path], object]) -> Callable[[Path], object]:
        TARGETS[name] = Target(name, suffix, seeds, read)
        return read

    return add
