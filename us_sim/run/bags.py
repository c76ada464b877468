"""Bags that a person may want to play: those of the working folder, and installed ones."""

from __future__ import annotations

import os
from pathlib import Path

from us_sim.share import shared_roots

__all__ = ["bags_in_reach"]

_MOST = 500
"""Bags of a folder that are listed, the newest."""


def bags_in_reach() -> dict[str, str]:
    """Files by the names that a person reads; the newest of the working folder come first."""
    bags: dict[str, str] = {}
    here = Path.cwd()
    folders = {here: "", here / "bags": "bags/"}
    for root in shared_roots():
        folders.setdefault(root / "bags", "")
    for folder, before in folders.items():
        for file in _newest_first(folder):
            bags.setdefault(f"{before}{file.name}", str(file))
    return bags


def _newest_first(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            found = [
                (entry.stat().st_mtime, Path(entry.path))
                for entry in entries
                if entry.name.endswith((".mcap", ".db3", ".mcap.zstd"))
                or os.path.isfile(Path(entry.path) / "metadata.yaml")
            ]
    except OSError:
        return []
    return [file for _, file in sorted(found, reverse=True)[:_MOST]]
