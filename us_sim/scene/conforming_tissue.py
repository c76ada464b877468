"""The box of a scene's tissue whose tetrahedra follow the surfaces of its structures.

Edges are as long as a structure's thickness and the distance from it and from the probe's edges
allow. All are scaled alike until the mesh has as many nodes as it may.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from us_sim.errors import MeshError
from us_sim.scene.case_tissue import box_planes, counts, footprint
from us_sim.scene.scene import Scene
from us_sim.settings.registry import COLLIDERS
from us_sim.tissue.elasticity.materials import LabelFractions, label_fractions
from us_sim.tissue.mesh.conforming import (
    EdgeLengths,
    conforming_mesh,
    require_mesher,
    with_inside_volume,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.structure_surface import coarsened, structure_surface
from us_sim.volume.volume import Volume

_logger = logging.getLogger(__name__)

_GROWTH = 0.35
"""By how much edges grow over a distance, per distance, as the spacing of a grid does."""

_UNDER_PROBE = 0.5
"""Edges under the probe over its half width."""

_AROUND = 0.5
"""Edges on a structure over its thickness: six around a vessel."""

_TOLERANCE = 0.03
"""How far faces may lie from a structure's surface, over its thickness."""

_BEYOND = 0.1
"""How far surfaces are drawn beyond the box, over its size, so that no cap of theirs is in it."""

_PLANES = 16
"""Along each axis, of the mesh that edge lengths are given on."""

_TRIALS = 6
_ENOUGH = 0.88
"""Part of the nodes that it may have with which a mesh is taken."""

_POWER = -2.2
"""Of the edges' scale, that the number of nodes goes by before two meshes tell."""


@dataclass(frozen=True, eq=False)
class _Structure:
    label: int
    surface: ClosedSurface
    thickness: float  # m, four times its volume over its area: a cylinder's diameter


def conforming_tissue(
    scene: Scene, volume: Volume, progress: Callable[[float, str], None] | None = None
) -> tuple[TetrahedralMesh, LabelFractions]:
    """A mesh whose tetrahedra are in one structure each, and their other materials.

    Layers and what is held have no surfaces of their own in it: of these each tetrahedron has
    fractions, as in a grid. A box without other structures is a grid.

    Raises:
        MeshError: a library is missing, fTetWild fails, or the surfaces need more nodes.
    """
    assert scene.tissue is not None
    given = scene.tissue.mesh
    assert isinstance(given.nodes, int)
    box = np.array([given.lower, given.upper])
    structures = _structures(scene, volume, box)
    if not structures:
        _logger.warning("no structure is in the tissue for its mesh to follow: it is a grid")
        mesh = box_mesh(*box_planes(scene, volume))
        if volume.labels is None:
            nothing = LabelFractions(np.zeros(1, np.uint8), np.ones((len(mesh.tetrahedra), 1)))
            return mesh, nothing
        return mesh, label_fractions(mesh, volume.labels, volume.patient_to_index)
    require_mesher()
    assert scene.probe.collider is not None
    pressed = footprint(scene.probe.collider.settings(COLLIDERS))
    mesh = _of_nodes(given.nodes, box, structures, pressed, progress)
    assert volume.labels is not None
    fractions = label_fractions(mesh, volume.labels, volume.patient_to_index)
    pure = _in_one_each(fractions, [one.label for one in structures])
    wanted = [float(fractions.of(one.label) @ mesh.volumes) for one in structures]
    for one, whole in zip(structures, wanted, strict=True):
        mesh = with_inside_volume(mesh, pure.of(one.label) > 0.5, whole)
    return mesh, pure


def _of_nodes(
    nodes: int,
    box: NDArray[np.float64],
    structures: Sequence[_Structure],
    pressed: tuple[float, float],
    progress: Callable[[float, str], None] | None,
) -> TetrahedralMesh:
    """The finest mesh of so many nodes at most that some trials find."""
    best: TetrahedralMesh | None = None
    tried: list[tuple[float, float]] = []  # logarithms of scales and nodes
    scale = 1.0
    for trial in range(_TRIALS):
        if progress is not None:
            progress(trial / _TRIALS, "a mesh that follows the structures")
        mesh = _at_scale(scale, box, structures, pressed)
        count = len(mesh.nodes)
        tried.append((math.log(scale), math.log(count)))
        if count <= nodes and (best is None or count > len(best.nodes)):
            best = mesh
            if count >= _ENOUGH * nodes:
                break
        scale = _next_scale(tried, math.log(nodes))
    if progress is not None:
        progress(1.0, "")
    if best is None:
        raise MeshError(
            "a mesh that follows these structures has "
            f"{round(math.exp(min(count for _, count in tried)))} nodes or more, and {nodes} are "
            f"allowed: raise `nodes`, leave structures out, or say `mesh: grid` in the case, "
            f"`kind: grid` in a scene's tissue.mesh"
        )
    return best


def _next_scale(tried: Sequence[tuple[float, float]], wanted: float) -> float:
    """The scale at which a power through the meshes above and below has somewhat fewer nodes."""
    aim = wanted + 0.5 * math.log(_ENOUGH)
    fewer = max((one for one in tried if one[1] <= aim), key=lambda one: one[1], default=None)
    more = min((one for one in tried if one[1] > aim), key=lambda one: one[1], default=None)
    if fewer is None or more is None:
        scale, count = fewer or more or (0.0, aim)
        return math.exp(scale + min(max((aim - count) / _POWER, -1.0), 1.0))
    part = (aim - fewer[1]) / (more[1] - fewer[1])
    part = min(max(part, 0.1), 0.9)  # meshes are not quite alike for scales that are
    return math.exp(fewer[0] + part * (more[0] - fewer[0]))


def _at_scale(
    scale: float,
    box: NDArray[np.float64],
    structures: Sequence[_Structure],
    pressed: tuple[float, float],
) -> TetrahedralMesh:
    surfaces = []
    for one in structures:
        edge = scale * _AROUND * one.thickness
        triangles = one.surface.area / (math.sqrt(3.0) / 4.0 * edge**2)
        coarse = coarsened(one.surface, max(8, round(triangles)))
        surfaces.append((coarse.vertices, coarse.triangles))
    tolerance = _TOLERANCE * min(one.thickness for one in structures)
    edges = _edge_lengths(scale, box, structures, pressed)
    return conforming_mesh(box, surfaces, edges, tolerance, coarsen=scale > 1.0)


def _edge_lengths(
    scale: float,
    box: NDArray[np.float64],
    structures: Sequence[_Structure],
    pressed: tuple[float, float],
) -> EdgeLengths:
    """How long edges should be in a box and around it."""
    beyond = _BEYOND * (box[1] - box[0])
    lower, upper = box[0] - beyond, box[1] + beyond
    grid = box_mesh(*(uniform_planes(lower[i], upper[i], _PLANES) for i in range(3)))
    outside = np.maximum(box[0] - grid.nodes, grid.nodes - box[1]).max(axis=1)
    beside = np.maximum(np.abs(grid.nodes) - [*pressed, box[0, 2]], 0.0)
    wanted = _UNDER_PROBE * pressed[1] + _GROWTH * np.linalg.norm(beside, axis=1)
    for one in structures:
        away = KDTree(one.surface.vertices).query(grid.nodes)[0]
        wanted = np.minimum(wanted, _AROUND * one.thickness + _GROWTH * away)
    wanted = np.minimum(wanted, (box[1] - box[0]).min() / 3.0)
    lengths = scale * np.where(outside > 0.0, 2.0 * wanted, wanted)  # which is left away
    return EdgeLengths(grid, lengths)


def _structures(scene: Scene, volume: Volume, box: NDArray[np.float64]) -> list[_Structure]:
    """Those whose surfaces the mesh follows, each as far as the box and a little beyond."""
    if volume.labels is None:
        return []
    block = _around(volume, box)
    if block is None or block.labels is None:
        return []
    here = np.flatnonzero(np.bincount(block.labels.ravel(), minlength=256))
    found = []
    for label in map(int, here):
        if label and counts(scene, block.label_names.get(label, "")):
            surface = structure_surface(block, label).surface
            found.append(_Structure(label, surface, 4.0 * surface.volume / surface.area))
    return found


def _around(volume: Volume, box: NDArray[np.float64]) -> Volume | None:
    """The part of a volume in a box and a little beyond; None where they do not meet."""
    assert volume.labels is not None
    beyond = _BEYOND * (box[1] - box[0])
    limits = np.stack([box[0] - beyond, box[1] + beyond])
    corners = np.stack(np.meshgrid(*limits.T, indexing="ij"), axis=-1).reshape(-1, 3)
    matrix = volume.patient_to_index
    indices = corners @ matrix[:3, :3].T + matrix[:3, 3]
    first = np.maximum(np.floor(indices.min(axis=0)).astype(int), 0)
    last = np.minimum(np.ceil(indices.max(axis=0)).astype(int) + 1, volume.labels.shape)
    if (last <= first).any():
        return None
    cut = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    placed = volume.index_to_patient.copy()
    placed[:3, 3] += placed[:3, :3] @ first
    return Volume(volume.intensities[cut], placed, volume.labels[cut], volume.label_names)


def _in_one_each(fractions: LabelFractions, followed: Sequence[int]) -> LabelFractions:
    """Tetrahedra that are mostly in a structure are in it, and others in none of these."""
    column = np.isin(fractions.labels, followed)
    inside = fractions.fractions[:, column]
    whole = np.column_stack([inside, 1.0 - inside.sum(axis=1)])
    most = whole.argmax(axis=1)
    made = np.where(column, 0.0, fractions.fractions)
    rest = made.sum(axis=1, keepdims=True)
    made = np.divide(made, rest, out=np.zeros_like(made), where=rest > 0.0)
    taken = most < inside.shape[1]
    made[taken] = 0.0
    made[np.flatnonzero(taken), np.flatnonzero(column)[most[taken]]] = 1.0
    return LabelFractions(fractions.labels, made)
