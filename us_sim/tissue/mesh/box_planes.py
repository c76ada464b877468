"""Planes of a box mesh, close together under the probe and where structures are thin.

Along each axis a spacing is wanted at every place; it may grow from one cell to the next by a
fraction only. The planes are spread so that each cell is as many times its wanted spacing long as
every other (equidistribution: de Boor, Lect Notes Math 363:12, 1974), and that number is the least
for which the box has no more nodes than it may.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError

_GROWTH = 0.35  # The most that the wanted spacing changes over a distance, per distance
_UNDER_PROBE = 0.5  # Spacing under the probe over its half width
_FEWEST = 3  # Planes along an axis
_BISECTIONS = 40


@dataclass(frozen=True, eq=False)
class DesiredSpacing:
    """The spacing that is wanted along one axis."""

    edges: NDArray[np.float64]  # (S + 1,) m, ascending, between parts of the axis
    spacing: NDArray[np.float64]  # (S,) m, in each part


def fit_planes(
    wanted: Sequence[DesiredSpacing], nodes: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit mesh planes (m, ascending) of x, y and z, from the first edge to the last of each.

    Args:
        wanted: spacing along x, y and z.
        nodes: the most that the box may have.

    Raises:
        MeshError: so few nodes make no box.
    """
    if nodes < _FEWEST**3:
        raise MeshError(f"a box of {nodes} nodes is none: give at least {_FEWEST**3}")
    smooth = [DesiredSpacing(axis.edges, _smoothed(axis)) for axis in wanted]
    cells = [float((np.diff(axis.edges) / axis.spacing).sum()) for axis in smooth]

    def counts(scale: float) -> list[int]:
        return [max(_FEWEST, math.ceil(number / scale - 1e-9) + 1) for number in cells]

    low, high = 1e-3, 1e6
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if math.prod(counts(middle)) <= nodes else (middle, high)
    x, y, z = (_spread(axis, n) for axis, n in zip(smooth, counts(high), strict=True))
    return x, y, z


def spacing_under_probe(
    wanted: Sequence[DesiredSpacing], half_length: float, half_width: float
) -> tuple[DesiredSpacing, DesiredSpacing, DesiredSpacing]:
    """Lower the desired spacing to what the probe's edges need.

    Under the probe, at the surface, that is half of the probe's half width; it grows with depth
    and beside the probe.

    Args:
        wanted: spacing along x, y and z.
        half_length: m, of the probe's footprint along x.
        half_width: m, along y.
    """
    least = _UNDER_PROBE * half_width
    found = []
    for axis, reach in zip(wanted, (half_length, half_width, 0.0), strict=True):
        centre = (axis.edges[1:] + axis.edges[:-1]) / 2
        beyond = np.maximum(np.abs(centre) - reach, 0.0)
        found.append(DesiredSpacing(axis.edges, np.minimum(axis.spacing, least + _GROWTH * beyond)))
    x, y, z = found
    return x, y, z


def _smoothed(axis: DesiredSpacing) -> NDArray[np.float64]:
    """Return the spacing, lowered where it would grow faster than `_GROWTH` from a neighbour's."""
    spacing = axis.spacing.astype(np.float64)
    steps = _GROWTH * np.diff((axis.edges[1:] + axis.edges[:-1]) / 2)
    for i in range(1, len(spacing)):
        spacing[i] = min(spacing[i], spacing[i - 1] + steps[i - 1])
    for i in range(len(spacing) - 2, -1, -1):
        spacing[i] = min(spacing[i], spacing[i + 1] + steps[i])
    return spacing


def _spread(axis: DesiredSpacing, count: int) -> NDArray[np.float64]:
    """Return ``count`` planes with equal parts of the wanted number of cells between them."""
    passed = np.concatenate([[0.0], np.cumsum(np.diff(axis.edges) / axis.spacing)])
    planes = np.interp(np.linspace(0.0, passed[-1], count), passed, axis.edges)
    planes[0], planes[-1] = axis.edges[0], axis.edges[-1]
    return planes


# Cells across a structure: the least with which its wall and its middle move differently.
_ACROSS = 3.0


def spacing_by_labels(
    labels: NDArray[np.uint8],
    index_from_patient: NDArray[np.float64],
    box: NDArray[np.float64],
    step: float,
    *,
    counted: Collection[int] | None = None,
    aside: float = math.inf,
) -> tuple[DesiredSpacing, DesiredSpacing, DesiredSpacing]:
    """Find the spacing along x, y and z that the structures in a box need.

    At each place along an axis it is a third of the thickness of the thinnest structure there,
    which is the median, over the structure's part of that cross-section, of how far it goes on
    along the axis. Where there is none, a third of the box.

    Args:
        labels: (i, j, k); 0 is no structure.
        index_from_patient: (4, 4), patient metres to voxel indices.
        box: (2, 3) m, lower and upper corner.
        step: m, at which labels are looked up.
        counted: labels of the structures that count; all but 0 without it. A layer, such as skin,
            is better left out: it moves with the tissue under it.
        aside: m, how far from y = 0 structures count for x and z.
    """
    counts = np.maximum(2, np.ceil((box[1] - box[0]) / step - 1e-9).astype(int))
    edges = [np.linspace(box[0, a], box[1, a], counts[a] + 1) for a in range(3)]
    centres = [(e[1:] + e[:-1]) / 2 for e in edges]
    grid = _sampled(labels, index_from_patient, centres)
    if counted is not None:
        grid[~np.isin(grid, list(counted))] = 0
    near = grid.copy()
    near[:, np.abs(centres[1]) > aside, :] = 0
    x, y, z = (
        DesiredSpacing(edges[a], _thickness(grid if a == 1 else near, a, edges[a]) / _ACROSS)
        for a in range(3)
    )
    return x, y, z


def _sampled(labels: NDArray, index_from_patient: NDArray, centres: list[NDArray]) -> NDArray:
    """Return the labels at a grid of points in ``patient``; 0 beyond the volume."""
    x, y, z = np.meshgrid(*centres, indexing="ij", sparse=True)
    inside = np.ones([len(c) for c in centres], dtype=bool)
    flat = np.zeros(inside.shape, dtype=np.int64)
    for axis in range(3):
        a, b, c, d = index_from_patient[axis]
        voxel = np.floor(a * x + b * y + c * z + (d + 0.5)).astype(np.int64)
        inside &= (voxel >= 0) & (voxel < labels.shape[axis])
        np.clip(voxel, 0, labels.shape[axis] - 1, out=voxel)
        flat = flat * labels.shape[axis] + voxel
    return np.where(inside, labels.reshape(-1)[flat], 0).astype(np.uint8)


def _thickness(grid: NDArray, axis: int, edges: NDArray) -> NDArray:
    """Return (S,) m, of the thinnest structure at each place along an axis of a label grid."""
    lines = np.moveaxis(grid, axis, 0).reshape(grid.shape[axis], -1)
    ends = np.ones((len(lines) + 1, lines.shape[1]), dtype=bool)
    ends[1:-1] = lines[1:] != lines[:-1]
    row = np.nonzero(ends.T)[1]
    starts = np.flatnonzero(row < len(lines))
    length = row[starts + 1] - row[starts]
    runs = np.repeat(length, length).reshape(lines.shape[1], -1).T  # of each point's label
    whole = edges[-1] - edges[0]
    step = whole / len(lines)
    thickness = np.full(len(lines), whole)
    for label in np.flatnonzero(np.bincount(grid.reshape(-1), minlength=256)[1:]) + 1:
        here = lines == label
        for place in np.flatnonzero(here.any(axis=1)):
            median = float(np.median(runs[place, here[place]]))
            thickness[place] = min(thickness[place], median * step)
    return thickness
