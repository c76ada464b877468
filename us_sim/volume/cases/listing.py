"""A line about each case: its name, region, probe, size and structures.

>>> from pathlib import Path
>>> from us_sim.volume.cases.listing import ListedCase, table
>>> probe = "linear, 40 mm deep"
>>> arm = ListedCase(Path("arm"), "arm", "upper arm", probe, "60 × 40 × 50 mm", "vein")
>>> print(table([arm]))
case  region     probe               size             structures
arm   upper arm  linear, 40 mm deep  60 × 40 × 50 mm  vein
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import UsSimError
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.registry import PROBES
from us_sim.volume.cases.case import read_case

_TITLES = ("case", "region", "probe", "size", "structures")
_LONGEST = 60  # characters of a column


@dataclass(frozen=True)
class ListedCase:
    """What a listing says of a case."""

    folder: Path
    name: str
    region: str = ""
    probe: str = ""
    size: str = ""
    structures: str = ""
    problem: str = ""  # why it cannot be used


def listed(folder: Path) -> ListedCase:
    """What there is to say of the case in a folder, from its texts and headers alone."""
    try:
        case = read_case(folder)
        matrix, shape = case.placement()
        if case.has_labels:
            case.check_grids()
    except UsSimError as error:
        return ListedCase(folder, folder.name, problem=str(error))
    voxel = np.linalg.norm(matrix[:3, :3], axis=0) * 1e3
    extent = " × ".join(f"{length:.0f}" for length in voxel * shape)
    sides = sorted({f"{side:.2g}" for side in voxel})
    settings = case.settings
    return ListedCase(
        folder,
        folder.name,
        settings.region or settings.name,
        _probe(settings.probe),
        f"{extent} mm, voxels of {' and '.join(sides)} mm",
        ", ".join(settings.structures) if case.has_labels else "not segmented",
    )


def table(cases: Sequence[ListedCase]) -> str:
    """The cases in columns, and under them what is wrong with those that cannot be used."""
    good = [case for case in cases if not case.problem]
    rows = [_TITLES, *((c.name, c.region, c.probe, c.size, c.structures) for c in good)]
    cut = [[text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..." for text in r] for r in rows]
    widths = [max(map(len, column)) for column in zip(*cut, strict=True)]
    lines = [
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in (cut if good else [])
    ]
    return "\n".join(
        [*lines, *(f"cannot be used: {case.problem}" for case in cases if case.problem)]
    )


def _probe(probe: ProbeSettings | None) -> str:
    if probe is None:
        return ""
    array: Any = probe.array.settings(PROBES)
    return f"{probe.geometry}, {array.depth * 1e3:.0f} mm deep"
