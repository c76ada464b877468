"""A surface with its name and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ColouredSurface:
    """A surface, and how it is shown."""

    name: str
    colour: tuple[float, float, float]  # red, green, blue, 0 to 1
    vertices: NDArray[np.float64]  # (V, 3) m
    triangles: NDArray[np.integer]  # (T, 3)
