"""What is imported: images of any format with what their header says, before any is left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.kept_part import Regions

Progress = Callable[[float, str], None]

LOOKED_AT = 12
"""Images in which text is looked for."""


class Voxels(Protocol):
    """Reads the voxels (i, j, k)."""

    def __call__(
        self, keep: NDArray[np.bool_] | None, progress: Progress | None, /
    ) -> NDArray[np.uint8]: ...


class Images(Protocol):
    """Reads the images (rows, columns), one after another."""

    def __call__(self, keep: NDArray[np.bool_] | None, /) -> Iterator[NDArray[np.uint8]]: ...


class Sides(Protocol):
    """Some slices across each of the other two axes, of what is kept of the images."""

    def __call__(self, keep: NDArray[np.bool_] | None, /) -> Iterator[list[NDArray[np.uint8]]]: ...


@dataclass(frozen=True, eq=False)
class Source:
    """Images of one volume or of one recording, as they come."""

    kind: str  # what the files hold, for a person and for provenance
    shape: tuple[int, int, int]  # columns, rows, images
    samples: list[NDArray[np.uint8]]  # some images as they are, from all over
    names: Mapping[str, int]  # what the header has, and how often
    kept: Mapping[str, str]  # values that may go on, by their fields
    conversions: tuple[str, ...]  # what is made of stored values
    regions: Regions  # of echoes, as the header says
    placement: NDArray[np.float64] | None  # (4, 4) m, from (column, row, image); None: no volume
    times: list[float]  # s, of images that are no volume
    pixel_mm: tuple[float, float]  # their width and height
    voxels: Voxels | None
    images: Images | None
    sides: Sides | None = None  # of a volume whose axes may be in another order than a scanner's


def spread(count: int) -> list[int]:
    """Up to `LOOKED_AT` numbers from all over a count."""
    return sorted({int(n) for n in np.linspace(0, count - 1, min(count, LOOKED_AT))})
