"""Stiffness of linear (Cauchy strain) tetrahedra, assembled in 3x3 blocks.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.linear_tetrahedra import stiffness
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([0.0, 0.1, 0.2], [0.0, 0.1], [0.0, 0.1])
>>> matrix = stiffness(mesh, uniform_material(mesh, Material(10e3, 0.45, 1000.0)))
>>> translation = np.tile([1.0, 0.0, 0.0], len(mesh.nodes))
>>> bool(abs(matrix @ translation).max() < 1e-9)  # moved as a whole, nothing resists
True
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


def shape_gradients(mesh: TetrahedralMesh) -> NDArray[np.float64]:
    """(M, 4, 3) 1/m, gradients of the four linear shape functions of each tetrahedron."""
    corners = mesh.nodes[mesh.tetrahedra]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.empty((len(corners), 4, 3))
    gradients[:, 1:] = inverse.transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    return gradients


def stiffness(mesh: TetrahedralMesh, materials: TissueMaterials) -> bsr_array:
    """(3N, 3N) N/m, symmetric, in 3x3 blocks with sorted columns.

    A tetrahedron of volume V couples its nodes a and b by
    V (lambda ga gb' + mu gb ga' + mu (ga . gb) I), with g the shape functions' gradients and lambda
    and mu Lame's constants (Zienkiewicz and Taylor, The Finite Element Method 1, 5th ed., 6.2).
    """
    modulus, ratio = materials.young_modulus, materials.poisson_ratio
    first = modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
    return lame_stiffness(mesh, first, modulus / (2 * (1 + ratio)))


def lame_stiffness(
    mesh: TetrahedralMesh, first: NDArray[np.float64], second: NDArray[np.float64]
) -> bsr_array:
    """As `stiffness`, of Lame's constants lambda and mu (M,) Pa themselves."""
    count = len(mesh.nodes)
    first = first * mesh.volumes
    second = second * mesh.volumes
    gradients = shape_gradients(mesh)
    outer = gradients[:, :, None, :, None] * gradients[:, None, :, None, :]
    local = first[:, None, None, None, None] * outer
    local += second[:, None, None, None, None] * outer.swapaxes(3, 4)
    dots = second[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    for axis in range(3):
        local[..., axis, axis] += dots

    rows = np.repeat(mesh.tetrahedra, 4, axis=1).ravel().astype(np.int64)
    columns = np.tile(mesh.tetrahedra, (1, 4)).ravel()
    pairs, place = np.unique(rows * count + columns, return_inverse=True)
    entries = local.reshape(-1, 9)
    blocks = np.empty((len(pairs), 9))
    for entry in range(9):
        blocks[:, entry] = np.bincount(place, entries[:, entry], len(pairs))
    start = np.searchsorted(pairs, np.arange(count + 1) * count).astype(np.int32)
    return bsr_array(
        (blocks.reshape(-1, 3, 3), (pairs % count).astype(np.int32), start),
        shape=(3 * count, 3 * count),
    )


def free_stiffness(matrix: bsr_array, fixed: NDArray[np.bool_]) -> bsr_array:
    """The stiffness without the rows and columns of fixed (N,) nodes."""
    rows = np.repeat(np.arange(len(fixed)), np.diff(matrix.indptr))
    kept = ~fixed[rows] & ~fixed[matrix.indices]
    number = np.cumsum(~fixed) - 1
    count = int((~fixed).sum())
    start = np.searchsorted(number[rows[kept]], np.arange(count + 1)).astype(np.int32)
    columns = number[matrix.indices[kept]].astype(np.int32)
    return bsr_array((matrix.data[kept], columns, start), shape=(3 * count, 3 * count))


def require_held(mesh: TetrahedralMesh, fixed: NDArray[np.bool_]) -> None:
    """Check that no part of the mesh can move as a rigid body.

    Tetrahedra of a part hang together by faces (`us_sim.tissue.mesh.check.check_mesh` refuses
    hinges), so that three of its nodes hold all of it.

    Raises:
        SolverError: a connected part has no three fixed nodes off one line.
    """
    nodes = np.flatnonzero(fixed)
    nodes = nodes[np.argsort(mesh.parts[nodes], kind="stable")]
    bounds = np.searchsorted(mesh.parts[nodes], np.arange(mesh.parts.max() + 2))
    for part, (first, last) in enumerate(itertools.pairwise(bounds)):
        held = mesh.nodes[nodes[first:last]]
        spread = np.zeros(3)
        if len(held) > 2:
            spread = np.linalg.svd(held - held.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-9 * spread[0]:
            line = " on one line" if len(held) > 2 else ""
            raise SolverError(
                f"the tissue can move as a whole: the part of the mesh around node "
                f"{np.argmax(mesh.parts == part)} has {len(held)} fixed nodes{line}; fix at least "
                f"three that are not on one line, such as the face `bottom`"
            )


def nodal_shear_stiffness(mesh: TetrahedralMesh, materials: TissueMaterials) -> NDArray[np.float64]:
    """(N,) N/m, how firmly each node resists a displacement of itself alone by shear."""
    shear = materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    resists = (shear * mesh.volumes)[:, None] * (shape_gradients(mesh) ** 2).sum(axis=2)
    total = np.zeros(len(mesh.nodes))
    np.add.at(total, mesh.tetrahedra, resists)
    return total
