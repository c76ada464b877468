"""How thick labelled structures are along x, y and z, and what spacing of mesh planes that asks.

>>> import numpy as np
>>> from us_sim.tissue.mesh.label_thickness import wanted_by_labels
>>> labels = np.zeros((40, 40, 40), np.uint8)
>>> labels[10:16, :, 20:29] = 3  # a vessel along y, 6 mm wide and 9 mm deep
>>> box = np.array([[0.0, 0.0, 0.0], [0.039, 0.039, 0.039]])
>>> x, y, z = wanted_by_labels(labels, np.diag([1e3, 1e3, 1e3, 1.0]), box, step=1e-3)
>>> [round(float(1e3 * s), 1) for s in (x.spacing[12], z.spacing[25])]  # mm, a third
[2.0, 3.0]
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.mesh.fitted_planes import Wanted

_ACROSS = 3.0
"""Cells across a structure: the least with which its wall and its middle move differently."""


def wanted_by_labels(
    labels: NDArray[np.uint8],
    index_from_patient: NDArray[np.float64],
    box: NDArray[np.float64],
    step: float,
    *,
    counted: Collection[int] | None = None,
    aside: float = math.inf,
) -> tuple[Wanted, Wanted, Wanted]:
    """The spacing along x, y and z that the structures in a box need.

    At each place along an axis it is a third of the thickness of the thinnest structure there,
    which is the median, over the structure's part of that cross-section, of how far it goes on
    along the axis. Where there is none, a third of the box.

    Args:
        labels: (i, j, k); 0 is no structure.
        index_from_patient: (4, 4), patient metres to voxel indices.
        box: (2, 3) m, lower and upper corner.
        step: m, at which labels are looked up.
        counted: labels of the structures that count; all but 0 without it. A layer, such as skin,
            is better left out: it moves with what is under it.
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
        Wanted(edges[a], _thickness(grid if a == 1 else near, a, edges[a]) / _ACROSS)
        for a in range(3)
    )
    return x, y, z


def _sampled(
    labels: NDArray[np.uint8],
    index_from_patient: NDArray[np.float64],
    centres: list[NDArray[np.float64]],
) -> NDArray[np.uint8]:
    """Labels at a grid of points in ``patient``; 0 beyond the volume."""
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


def _thickness(
    grid: NDArray[np.uint8], axis: int, edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(S,) m, of the thinnest structure at each place along an axis of a label grid."""
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
