"""The block of tissue that solvers press and slicers cut, and its meshes.

>>> from us_sim.evaluation.block import MESHES, make_block_mesh, make_graded_planes
>>> mesh = make_block_mesh(MESHES[0])
>>> len(mesh.nodes), len(mesh.tetrahedra)
(2000, 7695)
>>> make_graded_planes(0.0, 0.05, 0.0, 0.02, 0.01, 1.2).round(4).tolist()
[0.0, 0.01, 0.02, 0.0336, 0.05]
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes

EXTENT = ((-0.1, 0.1), (-0.05, 0.05), (0.0, 0.1))  # m, along x, y and z

MESHES = ((20, 10, 10), (24, 12, 12), (28, 14, 14), (32, 16, 16))
"""Nodes along x, y and z of the paper's four meshes (section VI)."""

LARGEST_MESH = (64, 32, 32)  # nodes along x, y and z


@cache
def make_block_mesh(counts: tuple[int, int, int]) -> TetrahedralMesh:
    """Make the mesh of the block at rest, with ``counts`` nodes along x, y and z."""
    return box_mesh(
        *(uniform_planes(*side, count) for side, count in zip(EXTENT, counts, strict=True))
    )


def make_graded_planes(
    low: float, high: float, fine_low: float, fine_high: float, size: float, growth: float
) -> NDArray[np.float64]:
    """Place planes (m) from ``low`` to ``high``, ``size`` apart in the fine range.

    Outside it each distance is about ``growth`` (above 1) times the one before.
    """
    count = max(1, round((fine_high - fine_low) / size))
    parts = [np.linspace(fine_low, fine_high, count + 1)]
    for length, end, direction in (
        (fine_low - low, fine_low, -1),
        (high - fine_high, fine_high, 1),
    ):
        if length > 0:
            number = max(1, round(np.log1p(length / size * (1 - 1 / growth)) / np.log(growth)))
            steps = growth ** np.arange(1, number + 1)
            parts.append(end + direction * length * np.cumsum(steps) / steps.sum())
    planes = np.unique(np.concatenate(parts))
    planes[[0, -1]] = low, high
    return planes
