"""Triangles of a sphere, for tests of surfaces."""

import numpy as np


def sphere(radius, rings=40, centre=(0.0, 0.0, 0.0)):
    """Vertices and outward triangles of a sphere, a single vertex at each pole."""
    polar, around = np.pi * np.arange(1, rings) / rings, np.pi * np.arange(2 * rings) / rings
    points = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.repeat(np.cos(polar)[:, None], len(around), axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    n = len(around)
    i, j = np.meshgrid(np.arange(rings - 2), np.arange(n), indexing="ij")
    a, b, c, d = (1 + k for k in (i * n + j, i * n + (j + 1) % n, (i + 1) * n + (j + 1) % n,
                                  (i + 1) * n + j))  # fmt: skip
    j = np.arange(n)
    last = (rings - 1) * n + 1
    triangles = np.concatenate(
        [
            np.stack([a, d, c], -1).reshape(-1, 3),
            np.stack([a, c, b], -1).reshape(-1, 3),
            np.column_stack([np.zeros(n, int), 1 + j, 1 + (j + 1) % n]),
            np.column_stack([np.full(n, last), last - n + (j + 1) % n, last - n + j]),
        ]
    )
    vertices = np.vstack([[0.0, 0, 1], points, [0, 0, -1]])
    return vertices * radius + np.array(centre), triangles
