"""Planes of a box mesh put where they count: under the probe, and where structures are thin.

Along each axis a spacing is wanted at every place; it may grow from one cell to the next by a
fraction only. The planes are spread so that each cell is as many times its wanted spacing long as
every other (equidistribution: de Boor, Lect Notes Math 363:12, 1974), and that number is the least
for which the box has no more nodes than it may.

>>> import numpy as np
>>> from us_sim.tissue.mesh.fitted_planes import Wanted, fitted_planes
>>> x = Wanted(np.linspace(-0.03, 0.03, 61), np.where(abs(np.arange(60) - 29.5) < 5, 1e-3, 8e-3))
>>> y = z = Wanted(np.linspace(0.0, 0.03, 31), np.full(30, 6e-3))
>>> planes = fitted_planes((x, y, z), nodes=500)
>>> steps = np.diff(planes[0])
>>> [len(p) for p in planes], bool(steps.min() < 0.4 * steps.max())
([19, 5, 5], True)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError

_GROWTH = 0.35
"""The most that the wanted spacing changes over a distance, per distance."""

_UNDER_PROBE = 0.5
"""Spacing under the probe over its half width."""

_FEWEST = 3
"""Planes along an axis."""

_BISECTIONS = 40


@dataclass(frozen=True, eq=False)
class Wanted:
    """The spacing that is wanted along one axis."""

    edges: NDArray[np.float64]  # (S + 1,) m, ascending, between parts of the axis
    spacing: NDArray[np.float64]  # (S,) m, in each part


def fitted_planes(
    wanted: Sequence[Wanted], nodes: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mesh planes (m, ascending) of x, y and z, from the first edge to the last of each.

    Args:
        wanted: of the three axes.
        nodes: that the box has at most.

    Raises:
        MeshError: so few nodes make no box.
    """
    if nodes < _FEWEST**3:
        raise MeshError(f"a box of {nodes} nodes is none: give at least {_FEWEST**3}")
    smooth = [Wanted(axis.edges, _smoothed(axis)) for axis in wanted]
    cells = [float((np.diff(axis.edges) / axis.spacing).sum()) for axis in smooth]

    def counts(scale: float) -> list[int]:
        return [max(_FEWEST, math.ceil(number / scale - 1e-9) + 1) for number in cells]

    low, high = 1e-3, 1e6
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if math.prod(counts(middle)) <= nodes else (middle, high)
    x, y, z = (_spread(axis, n) for axis, n in zip(smooth, counts(high), strict=True))
    return x, y, z


def wanted_under_probe(
    wanted: Sequence[Wanted], half_length: float, half_width: float
) -> tuple[Wanted, Wanted, Wanted]:
    """The spacing that is wanted, where it is less than what the probe's edges need.

    Under the probe, at the surface, that is half of the probe's half width; it grows with depth
    and beside the probe.

    Args:
        wanted: of x, y and z.
        half_length, half_width: m, of what presses, along x and y.
    """
    least = _UNDER_PROBE * half_width
    found = []
    for axis, reach in zip(wanted, (half_length, half_width, 0.0), strict=True):
        centre = (axis.edges[1:] + axis.edges[:-1]) / 2
        beyond = np.maximum(np.abs(centre) - reach, 0.0)
        found.append(Wanted(axis.edges, np.minimum(axis.spacing, least + _GROWTH * beyond)))
    x, y, z = found
    return x, y, z


def _smoothed(axis: Wanted) -> NDArray[np.float64]:
    """The wanted spacing, lowered where it would grow faster than `_GROWTH` from a neighbour's."""
    spacing = axis.spacing.astype(np.float64)
    steps = _GROWTH * np.diff((axis.edges[1:] + axis.edges[:-1]) / 2)
    for i in range(1, len(spacing)):
        spacing[i] = min(spacing[i], spacing[i - 1] + steps[i - 1])
    for i in range(len(spacing) - 2, -1, -1):
        spacing[i] = min(spacing[i], spacing[i + 1] + steps[i])
    return spacing


def _spread(axis: Wanted, count: int) -> NDArray[np.float64]:
    """``count`` planes with as much of the wanted number of cells between each two."""
    passed = np.concatenate([[0.0], np.cumsum(np.diff(axis.edges) / axis.spacing)])
    planes = np.interp(np.linspace(0.0, passed[-1], count), passed, axis.edges)
    planes[0], planes[-1] = axis.edges[0], axis.edges[-1]
    return planes
