"""Random meshes, deformations and planes on which every slicing method must agree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial import Delaunay

from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SLICERS
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

every_method = pytest.mark.parametrize("method", [*SLICERS])

KINDS = ("box", "cloud", "tangled", "squashed", "aligned", "through_nodes", "coarse", "fan")
SIZE = np.array([0.06, 0.04, 0.05])
"""m, of the box meshes: from (-x/2, -y/2, 0) to (x/2, y/2, z)."""
LOW, HIGH = -SIZE / [2, 2, 1] * [1, 1, 0], SIZE / [2, 2, 1]


class Case(NamedTuple):
    """A mesh at rest, its nodes moved, and the plane that cuts it."""

    rest_nodes: np.ndarray  # (N, 3) m
    tetrahedra: np.ndarray  # (M, 4)
    nodes: np.ndarray  # (N, 3) m
    plane: SlicePlane
    volume: Volume


def noise_volume(shape, steps, corner, turn=None, seed=0):
    """Noise with four labels; ``corner`` (3,) m is the outer corner of the first voxel."""
    to_patient = np.diag([*steps, 1.0])
    to_patient[:3, 3] = np.asarray(corner) + 0.5 * np.asarray(steps)
    if turn is not None:
        to_patient = turn.matrix @ to_patient
    voxels = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return Volume(voxels, to_patient, voxels // 64, {1: "a", 2: "b", 3: "c"})


def box(counts):
    """The box mesh with so many planes along x, y and z."""
    return box_mesh(*(uniform_planes(*ends) for ends in zip(LOW, HIGH, counts, strict=True)))


def around_the_box(seed=0):
    """A volume larger than the box on all sides."""
    return noise_volume((44, 34, 40), (2e-3, 2e-3, 2e-3), (-0.044, -0.034, -0.015), seed=seed)


def plane_of_nodes(mesh, axis, layer):
    """Pixels on the nodes of a layer of a box mesh, and on its edges and faces."""
    planes = [np.unique(mesh.nodes[:, a]) for a in range(3)]
    u, v = (a for a in range(3) if a != axis)
    origin = np.array([p[0] for p in planes])
    origin[axis] = planes[axis][layer]
    steps = [np.eye(3)[a] * (planes[a][1] - planes[a][0]) / 4 for a in (u, v)]
    columns, rows = (4 * (len(planes[a]) - 1) + 1 for a in (u, v))
    return SlicePlane(origin, *steps, columns=columns, rows=rows)


def checkers(volume):
    """The steepest grey values there are, in the place of a volume."""
    grey = np.indices(volume.shape).sum(axis=0) % 2 * 255
    return Volume(grey.astype(np.uint8), volume.index_to_patient, volume.labels)


# Around the box meshes; ending within them, with its faces on pixels; oblique; one voxel thick.
_AROUND = noise_volume((40, 30, 36), (2e-3, 2e-3, 2e-3), (-0.04, -0.03, -0.01))
VOLUMES = (
    _AROUND,
    checkers(_AROUND),
    noise_volume((20, 16, 18), (2e-3, 2e-3, 2e-3), (-0.02, -0.016, 0.004)),
    noise_volume((50, 40, 30), (1.7e-3, 2.1e-3, 2.9e-3), (-0.04, -0.045, -0.015),
                 Pose([2e-3, 1e-3, 0.0], [0.1, -0.15, 0.2, 1.0])),
    noise_volume((1, 9, 11), (0.07, 5e-3, 5e-3), (-0.035, -0.022, -0.002)),
    noise_volume((13, 9, 1), (5e-3, 5e-3, 0.03), (-0.035, -0.022, 0.005)),
)  # fmt: skip


def random_case(kind: str, seed: int) -> Case:
    """One of `KINDS`, reproducibly."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    volume = VOLUMES[rng.integers(len(VOLUMES))]
    if kind == "aligned":
        return _aligned(rng, volume)
    rest_nodes, tetrahedra = _cloud(rng) if kind == "cloud" else _box(rng)
    if rng.random() < 0.3:
        # A mesh may name the corners of a tetrahedron in either order.
        swapped = rng.random(len(tetrahedra)) < 0.5
        tetrahedra[swapped] = tetrahedra[swapped][:, [1, 0, 2, 3]]
    strength = {"tangled": rng.uniform(0.4, 1.5)}.get(kind, rng.uniform(0.0, 0.3))
    nodes = _deformed(rng, rest_nodes, strength)
    if kind == "squashed":
        factors = 10.0 ** rng.uniform(-2.0, 0.5, 3)
        nodes = (nodes - [0, 0, 0.025]) * factors + [0, 0, 0.025]
    if kind == "through_nodes":
        plane = _plane_through_nodes(rng, nodes, tetrahedra)
    else:
        plane = _oblique_plane(rng, nodes, coarse=kind == "coarse")
    if kind == "fan":
        plane = _fan(rng, plane)
    return Case(rest_nodes, tetrahedra, nodes, plane, volume)


def _box(rng):
    """A box mesh with irregular planes."""
    planes = []
    for low, high in zip(LOW, HIGH, strict=True):
        inner = low + (high - low) * rng.uniform(0.03, 0.97, rng.integers(0, 4))
        planes.append(np.unique(np.round([low, *inner, high], 5)))
    mesh = box_mesh(*planes)
    return mesh.nodes, mesh.tetrahedra.copy()


def _cloud(rng):
    """A Delaunay tetrahedralisation of random points, without its flat tetrahedra."""
    points = rng.uniform(LOW, HIGH, (rng.integers(6, 40), 3))
    tetrahedra = Delaunay(points).simplices.astype(np.int32)
    edges = points[tetrahedra][:, 1:] - points[tetrahedra][:, :1]
    size = np.abs(np.linalg.det(edges)) / np.linalg.norm(edges, axis=2).max(axis=1) ** 3
    return points, tetrahedra[size > 1e-4]


def _deformed(rng, nodes, strength):
    """A smooth pressing and turning, and every node moved on its own besides."""
    if rng.random() < 0.1:
        return nodes.copy()
    x, y, z = nodes.T
    dent = np.exp(-(x**2 + y**2) / 0.02**2) * rng.uniform(0.0, 0.02) * (1 - z / SIZE[2])
    moved = nodes + np.column_stack([0 * dent, 0 * dent, dent])
    moved += rng.uniform(-1.0, 1.0, nodes.shape) * strength * 0.012
    turn = Pose(rng.normal(scale=0.003, size=3), [*rng.normal(scale=0.15, size=3), 1.0])
    return turn.transform_points(moved)


def _counts(rng):
    """Columns and rows: as images have them, a few wide rows, and single rows and columns."""
    counts = (64, 48), (41, 57), (90, 40), (900, 4), (1, 64), (64, 1)
    return counts[rng.choice(6, p=[0.3, 0.3, 0.2, 0.1, 0.05, 0.05])]


def _oblique_plane(rng, nodes, coarse=False):
    """A plane in any direction, through the mesh, beside it or off it."""
    columns, rows = _counts(rng)
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    middle = 0.5 * (low + high + rng.normal(scale=0.5, size=3) * (high - low))
    pose = Pose(middle, rng.normal(size=4))
    steps = np.exp(rng.uniform(np.log(1e-4), np.log(2e-3), 2))
    if coarse:  # tetrahedra smaller than a pixel, or an image within one of them
        steps = np.exp(rng.uniform(np.log(1e-6), np.log(5e-2), 2))
    across = pose.rotation @ [steps[0] * columns / 2, 0.0, steps[1] * rows / 2]
    skew = rng.normal(scale=0.2) if rng.random() < 0.1 else 0.0
    return SlicePlane(
        pose.position - across,
        pose.rotation[:, 0] * steps[0],
        (pose.rotation[:, 2] + skew * pose.rotation[:, 0]) * steps[1],
        columns=columns,
        rows=rows,
    )


def _plane_through_nodes(rng, nodes, tetrahedra):
    """A plane with pixels exactly on three nodes, of one tetrahedron or of several."""
    columns, rows = _counts(rng)
    while True:
        chosen = tetrahedra[rng.integers(len(tetrahedra))][rng.permutation(4)[:3]]
        if rng.random() < 0.3:
            chosen = rng.choice(len(nodes), 3, replace=False)
        corner, along, down = nodes[chosen]
        edges = along - corner, down - corner
        lengths = [np.linalg.norm(edge) for edge in edges]
        if np.linalg.norm(np.cross(*edges)) > 0.02 * lengths[0] * lengths[1] > 1e-9:
            break
    counts = rng.integers(1, 30, 2)
    steps = edges[0] / counts[0], edges[1] / counts[1]
    back = rng.integers(0, [columns, rows]) // 2
    return SlicePlane(
        corner - back[0] * steps[0] - back[1] * steps[1], *steps, columns=columns, rows=rows
    )


def _aligned(rng, volume):
    """Mesh planes, volume and pixels on one grid of millimetres, all of it turned or not."""
    pixel = 1e-3
    planes = [
        pixel * np.array([low, *sorted(rng.choice(np.arange(low + 1, high), n, replace=False)),
                          high])
        for low, high, n in zip((-30, -20, 0), (30, 20, 50), rng.integers(0, 4, 3), strict=True)
    ]  # fmt: skip
    mesh = box_mesh(*planes)
    nodes = mesh.nodes.copy()
    if rng.random() < 0.7:
        nodes += pixel * rng.integers(-3, 4, nodes.shape) * (rng.random(len(nodes)) < 0.3)[:, None]
    axis = rng.integers(3)
    across, down = rng.permutation([a for a in range(3) if a != axis])
    origin = pixel * np.round(rng.uniform(-0.6, 0.2, 3) * SIZE / pixel)
    directions = np.eye(3) * rng.choice([-1.0, 1.0], 3)[:, None]
    share = rng.choice([1, 2, 4])
    columns, rows = _counts(rng)
    origin -= np.minimum(directions, 0.0).sum(axis=1) * columns * pixel / share
    origin[axis] = rng.choice(nodes[:, axis])
    turn = Pose()
    if rng.random() < 0.3:
        turn = Pose(rng.normal(scale=0.01, size=3), rng.normal(size=4))
    rest = mesh.nodes
    if rng.random() < 0.3:
        # The rest turned as well: pixels on the surface that tissue moved away from.
        rest = turn.transform_points(mesh.nodes)
    plane = SlicePlane(
        turn.transform_points(origin[None])[0],
        turn.rotation @ directions[across] * pixel / share,
        turn.rotation @ directions[down] * pixel / share,
        columns=columns,
        rows=rows,
    )
    return Case(rest, mesh.tetrahedra.copy(), turn.transform_points(nodes), plane, volume)


def _fan(rng, plane):
    """The plane with up to two random runs of columns a row."""
    ends = np.sort(rng.integers(0, plane.columns + 1, (plane.rows, 4)), axis=1)
    ends[rng.random(plane.rows) < 0.1] = 0
    return SlicePlane(
        plane.origin, plane.column_step, plane.row_step, columns=plane.columns, rows=plane.rows,
        spans=ends.reshape(-1, 2, 2).astype(np.int32),
    )  # fmt: skip


def tetrahedra_at(case, points, slack=1e-7):
    """Which valid tetrahedra hold points (P, 3): (P, M), and the places at rest (P, M, 3) m."""
    now, rest = case.nodes[case.tetrahedra], case.rest_nodes[case.tetrahedra]
    edges, rest_edges = now[:, 1:] - now[:, :1], rest[:, 1:] - rest[:, :1]
    size, rest_size = np.linalg.det(edges), np.linalg.det(rest_edges)
    valid = size * np.sign(rest_size) > 1e-6 * np.abs(rest_size)
    edges[~valid] = np.eye(3)
    inverse = np.linalg.inv(edges)
    weights = np.einsum("pmj,mjk->pmk", points[:, None] - now[:, 0], inverse)
    inside = (weights >= -slack).all(axis=-1) & (weights.sum(axis=-1) <= 1 + slack) & valid
    return inside, rest[:, 0] + np.einsum("pmk,mkj->pmj", weights, rest_edges)


def between_voxels(index):
    """Whether an index (..., 3) lies as near to one voxel's centre as to another's: no matter."""
    return (np.abs(index % 1.0 - 0.5) < 1e-3).any(axis=-1)


def sampled(volume, index):
    """Grey values by scipy and the nearest labels at ``index`` (..., 3), 0 beyond the volume."""
    last = np.array(volume.shape) - 1
    within = ((index >= -0.5 - 1e-6) & (index <= last + 0.5 + 1e-6)).all(axis=-1)
    held = np.where(within[..., None], np.clip(index, 0, last), 0.0)
    grey = map_coordinates(volume.intensities.astype(float), np.moveaxis(held, -1, 0), order=1)
    label = volume.labels[tuple(np.moveaxis(np.floor(held + 0.5).astype(int), -1, 0))]
    return np.floor(grey + 0.5) * within, label * within
