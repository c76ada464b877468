"""What an import made, and what it left out: the facts of its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.rectangle import Rectangle


@dataclass(frozen=True, eq=False)
class Imported:
    """An import, before or after it is written."""

    kind: str  # what the files hold: "Enhanced US Volume Storage", "NRRD volume"
    files: int
    what: str  # what is made of them, with its size, for a person
    kept: Mapping[str, str]  # values that go on, by their fields
    used: Mapping[str, int]  # elements of which only the effect goes on, and how many of each
    dropped: Mapping[str, int]  # all others
    conversions: tuple[str, ...]
    blanked: str  # what of the images is not kept, for a person
    first: NDArray[np.uint8]  # (rows, columns) the first image as it was: it may show a name
    regions: tuple[Rectangle, ...]  # what of it is kept
    text: tuple[Rectangle, ...]  # where text may be, in `first`
    remaining: tuple[Rectangle, ...]  # of these, what is kept: partly or wholly
    undecided: str = ""  # why nothing can be written before a person has decided
    blanking_settles: bool = False  # that --blank-text would be a decision
    proposal: Rectangle | None = None  # what to keep, by what moves and shines
    counts: Mapping[str, int] = field(default_factory=dict)
